"""Where nothing may be written: among photographs, masks and sparse models, which cannot be made again, and among which
a picture of ours would be taken for one more photograph.

`check_output` is asked by every verb, for every option that is marked `Output` (`config.output_paths`), and by what
does the work, for those who call it from Python. What is allowed:

- a folder beside the photographs, also in a capture whose photographs lie in `images/`, and in a project's folder whose
  photographs lie in folders of their own (`project/DCIM`, `project/run`);
- anything in a run but the folders of its stages, and in a capture but its inputs, wherever the run or capture lies;
- a new folder in a capture whose photographs lie in its root (no file there);
- a folder of results (a render, maps): they are no photographs (`strays.why_not_read`);
- a file that nobody takes for a photograph (a page, a file of Gaussians or points), but in what a camera fills, nor
  points where a capture with photographs in its root looks for its own.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vdgs.captures.formats.colmap import find_models
from vdgs.captures.formats.llff import is_llff
from vdgs.captures.formats.matrixcity import pose_files
from vdgs.captures.formats.mega_nerf import is_mega_nerf
from vdgs.captures.formats.mvsnet import is_mvsnet
from vdgs.captures.image_files import has_camera
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES, OTHER_IMAGE_SUFFIXES
from vdgs.captures.project_formats import is_project
from vdgs.captures.reconstruction import is_reconstruction
from vdgs.captures.strays import is_result, is_run, why_not_read
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty

if TYPE_CHECKING:
    from vdgs.captures.capture import Capture

#: What the folders of a capture that hold its inputs are usually called, in its root.
_USUAL = re.compile(r"(blended_)?images(_\d+)?|masks|sparse|colmap|cams(_\w+)?|cameras", re.IGNORECASE)
#: What the stages of a run call their folders in it.
_OF_STAGES = re.compile(r"coarse|visibility|partition|blocks|merged|lod|evaluation(_\w+)?")
#: The same in the parts `train` and `val` of a capture in Mega-NeRF's layout.
_MEGA_NERF = ("rgbs", "metadata")
#: What cameras call the folder of all that they took.
_CAMERA_FOLDER = "dcim"
#: Endings of single files that cannot be taken for photographs and hold none beside them.
_NO_PICTURES = {".html", ".ply", ".spz", ".splat", ".sog", ".rad", ".glb", ".laz", ".las"}
#: Those that hold points, or Gaussians, which are read as such.
_POINTS = {".ply", ".laz", ".las"}
#: So many pictures are photographs, whatever they say of themselves: with fewer there is no scene (`sfm.image_list`).
_MANY_PICTURES = 3


def check_output(output: Path) -> None:
    """Raise VdgsError where `output` lies in a folder of inputs of some capture, known by its name and its neighbors,
    or in a folder of photographs.

    `output` is a file or folder that need not be there yet; links and `..` are followed. Reads no capture, so that it
    can be asked before anything else; `check_not_among_inputs` knows folders of other names too.
    """
    real = Path(os.path.realpath(output))
    _check_not_in_capture(output, real)
    _check_no_points(output, real)
    found = [folder for folder in _folders_around(real) if _holds_photographs(folder, real)]
    if found:
        raise VdgsError(
            f"{output}: lies among the photographs in {found[0]}, where it would be taken for more of them. Nothing "
            f"was written. Choose a folder outside of it, such as {_place_beside(found[-1], real)}"
        )


def check_no_link(output: Path) -> None:
    """Raise VdgsError where `output` is a link to a file, or to nothing; links to folders are as good as these.

    A file comes to stand in the place of a link, and never in what the link leads to: that may be the store of another
    program, or of another run.
    """
    if output.is_symlink() and not output.is_dir():
        raise VdgsError(
            f"{output}: is a link to {os.readlink(output)}, which the output would replace. Nothing was written. Give "
            "the path that it leads to, or remove the link."
        )


def _check_not_in_capture(output: Path, real: Path) -> None:
    for folder in (real, *real.parents):
        parent = folder.parent
        if _OF_STAGES.fullmatch(folder.name) and is_run(parent):
            raise VdgsError(
                f"{output}: lies in {folder}, which a stage of the run {parent} fills and clears. Nothing was written. "
                f"Choose another place, such as {parent / 'export' / real.name}"
            )
        if _USUAL.fullmatch(folder.name) and is_capture(parent):
            raise _error(output, folder, parent)
        if folder.name in _MEGA_NERF and is_mega_nerf(parent.parent):
            raise _error(output, folder, parent.parent)


def _check_no_points(output: Path, real: Path) -> None:
    root = real.parent
    if real.suffix.lower() not in _POINTS or real.is_dir() or not is_capture(root):
        return
    if _holds_photographs(root, root):
        raise VdgsError(
            f"{output}: lies in the root of the capture {root}, where it would be taken for the capture's points. "
            f"Nothing was written. Choose a folder outside of it, such as {_place_beside(root, real)}"
        )


def _folders_around(real: Path) -> list[Path]:
    """The output and the folders around the output, up to the first run or capture, in which results may lie. The root
    of a capture is included where a file would be written into the root."""
    around: list[Path] = []
    for folder in (real, *real.parents):
        if is_run(folder):
            break
        if is_capture(folder) or is_reconstruction(folder):
            return [*around, folder] if _is_written_into(folder, real) else around
        around.append(folder)
    return around


def _is_written_into(folder: Path, output: Path) -> bool:
    """Whether the output is the folder, or a file (by its ending, where it is not there yet) in it."""
    is_file = bool(output.suffix) and not output.is_dir()
    return output == folder or (is_file and output.parent == folder)


def _holds_photographs(folder: Path, output: Path) -> bool:
    """Whether an output in a folder would lie among photographs.

    Where it is the folder, few pictures are enough. A file in the folder is refused for one of a camera, and for a
    numbered series that is most of what is there; further up most of what is there must be pictures, or belong to a
    series of them. Neither a home folder with some pictures nor one of screenshots is a folder of photographs.
    """
    try:
        names = {entry.name: entry.is_file() for entry in os.scandir(folder) if not entry.name.startswith(".")}
    except OSError:  # is not there yet, is a file, or cannot be read
        return False
    if folder.name.lower() == _CAMERA_FOLDER:
        return True
    if why_not_read(folder) is not None or (output.suffix.lower() in _NO_PICTURES and not output.is_dir()):
        return False
    suffixes = IMAGE_SUFFIXES | OTHER_IMAGE_SUFFIXES
    pictures = [folder / name for name, is_file in names.items() if is_file and Path(name).suffix.lower() in suffixes]
    pictures = [picture for picture in _without_undistorted(pictures, names) if not is_result(picture)]
    if output == folder:
        return len(pictures) >= _MANY_PICTURES or any(map(has_camera, pictures))
    many, in_series = max(_MANY_PICTURES, len(names) / 2), _series_length(pictures, names)
    if _is_written_into(folder, output):
        return in_series >= many or any(map(has_camera, pictures))
    return max(len(pictures), in_series) >= many


def _series_length(pictures: Sequence[Path], names: Collection[str]) -> int:
    """How many files belong to a series, as a camera or a film leaves it: three pictures or more of one ending whose
    names differ by their numbers, and what is called like these (films, and what says something of each picture)."""
    counts = Counter((_without_numbers(picture.name), picture.suffix.lower()) for picture in pictures)
    series = {name for (name, _), count in counts.items() if count >= _MANY_PICTURES}
    return sum(_without_numbers(name) in series for name in names)


def _without_numbers(name: str) -> str:
    return re.sub(r"\d+", "0", Path(name).stem)


def _without_undistorted(pictures: list[Path], names: Collection[str]) -> list[Path]:
    """The pictures without those of `undistort`, which have a record beside them, and without the masks of these."""
    recorded = [picture.name for picture in pictures if f"{picture.name}.json" in names]
    if not recorded or "made_from" not in read_json_or_empty(pictures[0].parent / f"{recorded[0]}.json"):
        return pictures
    ours = set(recorded)
    return [picture for picture in pictures if picture.name.removesuffix(".mask.png") not in ours]


def _place_beside(photographs: Path, output: Path) -> Path:
    """A folder or file that may be written instead: beside the outermost folder of photographs."""
    name = output.name if output != photographs else f"{photographs.name}-results"
    return photographs.parent / name


def check_not_among_inputs(output: Path, capture: Capture) -> None:
    """Raise VdgsError where `output` lies among the photographs or masks of this capture, wherever they are, or among
    the inputs of any other, or other photographs (`check_output`)."""
    check_not_among_folders(output, capture.root, input_folders(capture))


def input_folders(capture: Capture) -> list[Path]:
    """The folders that hold photographs or masks of a capture, wherever they are."""
    views = capture.views + capture.off_path_views
    files = [view.image_path for view in views]
    files += [view.mask_path for view in views if view.mask_path is not None]
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
    real = Path(os.path.realpath(output))
    around = {_identity(folder) for folder in (real, *real.parents)} - {None}
    whole_capture = Path(os.path.realpath(root))
    above_root = {_identity(folder) for folder in (whole_capture, *whole_capture.parents)}
    for folder in folders:
        known = _identity(folder)
        if known in around and (known not in above_root or known == _identity(real)):
            raise _error(output, folder, root)
    check_output(output)


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
        if (root / "transforms.json").is_file() or is_mega_nerf(root) or pose_files(root) or find_models(root):
            return True
        if is_mvsnet(root) or is_llff(root):
            return True
        return is_project(root)
    except OSError:
        return False


def _error(output: Path, folder: Path, root: Path) -> VdgsError:
    return VdgsError(
        f"{output}: lies in {folder}, which is for inputs of the capture {root}: they would be overwritten, or mixed "
        "with results. Nothing was written. Choose a folder outside of it."
    )
