"""Where nothing may be written: among photographs, masks and sparse models, which cannot be made again."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

from vdgs.captures.capture import Capture
from vdgs.captures.formats.colmap import find_models
from vdgs.captures.formats.matrixcity import pose_files
from vdgs.captures.formats.mega_nerf import is_mega_nerf
from vdgs.errors import VdgsError

#: What the folders of a capture that hold its inputs are usually called, in its root.
_USUAL = re.compile(r"images(_\d+)?|masks|sparse|colmap", re.IGNORECASE)
#: The same in the parts `train` and `val` of a capture in Mega-NeRF's layout.
_MEGA_NERF = ("rgbs", "metadata")


def check_not_in_capture(output: Path) -> None:
    """Raise VdgsError where `output` lies in a folder of inputs of some capture, known by its name and its neighbours.

    `output` is a file or folder that need not be there yet; links and `..` are followed. Reads no capture, so that it
    can be asked before anything else; `check_not_among_inputs` knows folders of other names too.
    """
    real = Path(os.path.realpath(output))
    for folder in (real, *real.parents):
        parent = folder.parent
        if _USUAL.fullmatch(folder.name) and is_capture(parent):
            raise _error(output, folder, parent)
        if folder.name in _MEGA_NERF and is_mega_nerf(parent.parent):
            raise _error(output, folder, parent.parent)


def check_not_among_inputs(output: Path, capture: Capture) -> None:
    """Raise VdgsError where `output` lies among the photographs or masks of this capture, wherever they are, or among
    the inputs of any other (`check_not_in_capture`)."""
    check_not_among_folders(output, capture.root, input_folders(capture))


def input_folders(capture: Capture) -> list[Path]:
    """The folders that hold photographs or masks of a capture, wherever they are."""
    files = [view.image_path for view in capture.views]
    files += [view.mask_path for view in capture.views if view.mask_path is not None]
    if Path(capture.images) != Path():
        files.append(capture.root / capture.images / "any")
    return _folders_of(files)


def check_not_among_files(output: Path, root: Path, files: Sequence[Path]) -> None:
    """Raise VdgsError where `output` lies in, or is, a folder that holds one of the `files` of the capture in `root`.

    What the files are links to counts too.
    """
    check_not_among_folders(output, root, _folders_of(files))


def check_not_among_folders(output: Path, root: Path, folders: Sequence[Path]) -> None:
    """Raise VdgsError where `output` lies in, or is, one of the `folders` with inputs of the capture in `root`.

    Where inputs lie in the root itself, folders beside them are free.
    """
    check_not_in_capture(output)
    real = Path(os.path.realpath(output))
    around = {_identity(folder) for folder in (real, *real.parents)} - {None}
    whole_capture = Path(os.path.realpath(root))
    above_root = {_identity(folder) for folder in (whole_capture, *whole_capture.parents)}
    for folder in folders:
        known = _identity(folder)
        if known in around and (known not in above_root or known == _identity(real)):
            raise _error(output, folder, root)


def _folders_of(files: Sequence[Path]) -> list[Path]:
    """The folders that the files are in, and those that the files that are links lead into."""
    found = dict.fromkeys(file.parent for file in files)
    links = [Path(os.path.realpath(file)).parent for file in files if file.is_symlink()]
    return list(found | dict.fromkeys(links))


def _identity(folder: Path) -> tuple[int, int] | None:
    """What tells a folder from all others, under whichever name; None where there is none."""
    try:
        status = folder.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def is_capture(root: Path) -> bool:
    """Whether a folder is a capture, of any format that is read: photographs whose cameras are known."""
    try:
        known = (root / "transforms.json").is_file() or is_mega_nerf(root) or pose_files(root) or find_models(root)
    except OSError:
        return False
    return bool(known)


def _error(output: Path, folder: Path, root: Path) -> VdgsError:
    return VdgsError(
        f"{output}: lies in {folder}, which is for inputs of the capture {root}: they would be overwritten, or mixed "
        "with results. Nothing was written. Choose a folder outside of it."
    )
