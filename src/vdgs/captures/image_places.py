"""Where the photographs of a COLMAP model are: in images/, or in the only other place beside it that can hold them.

What is none: results and undistorted copies of ours, masks, and photographs of another kind of lens. Undistorted copies
would be undistorted once more by the lens of the originals, which shows nowhere but in blurred edges; originals would
stay bent under the pinhole of their copies.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vdgs.captures.folders_below import folders_below
from vdgs.captures.formats.colmap import find_models, read_lenses
from vdgs.captures.formats.transforms import TRANSFORMS_FILE, read_transforms
from vdgs.captures.image_files import find_images, readable_suffixes
from vdgs.captures.name_resolution import largest_shrunk, match_stem
from vdgs.captures.strays import (
    is_mask_folder,
    is_result,
    is_undistorted_folder,
    is_undistorted_here,
    why_not_read,
)
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word

#: What programs that undistort photographs call the folder of the originals (3DGS, nerfstudio).
_ORIGINALS = ("input", "distorted")


def image_folder(root: Path, options: CaptureOptions, is_bent: bool) -> tuple[str, list[str]]:
    """The image folder relative to `root`, and notes: the one asked for, else images, else the largest images_N, else
    the only other that can be of a model whose lens `is_bent`, or is a pinhole. Raises CaptureError where there is
    none, or several are, with their names."""
    if options.images is not None:
        return options.images, []
    if (root / "images").is_dir():
        return "images", []
    name = largest_shrunk(root, "images")
    if name is None:
        return _other_image_folder(root, is_bent)
    return name, [f"no images/ folder; {name} is used instead (--images chooses)."]


def _other_image_folder(root: Path, is_bent: bool) -> tuple[str, list[str]]:
    """`Images`, or the only other place of images beside the model, and a note. Raises CaptureError that names the
    places where there are several, and what to give instead of a model alone."""
    named = [entry.name for entry in sorted(root.iterdir()) if entry.is_dir() and _holds_photographs(entry)]
    alike = [name for name in named if name.lower() == "images"]
    if len(alike) == 1:
        return alike[0], [f"no images/ folder; {alike[0]} is used instead (--images chooses)."]
    likely = [name for name in named if not is_mask_folder(name) and not why_not_read(root / name)]
    captures = {name: capture for name in likely if (capture := _of_other_lens(root / name, is_bent))}
    apart = [name for name in likely if name in captures or _is_called_otherwise(name, is_bent)]
    likely = [name for name in likely if name not in apart]
    if any(entry.suffix.lower() in readable_suffixes() and not is_result(entry) for entry in root.iterdir()):
        named, likely = [*named, "."], [*likely, "."]
    if len(likely) == 1:
        return likely[0], [f"no images/ folder; the photographs in {root / likely[0]} are used (--images chooses)."]
    if not likely and apart:
        raise _of_other_photographs(root, apart, captures, is_bent)
    if not named:
        _refuse_model_alone(root)
    raise _no_one_folder(root, [name for name in named if name not in apart], likely)


def _holds_photographs(folder: Path) -> bool:
    """Whether images lie in a folder or below it that are neither results nor undistorted copies of ours; of the latter
    the first tells."""
    first = next((path for path in find_images(folder).values() if not is_result(path)), None)
    return first is not None and not is_undistorted_here(first)


def _is_called_otherwise(name: str, is_bent: bool) -> bool:
    """Whether a folder is called as one of photographs of the other kind of lens."""
    return is_undistorted_folder(name) if is_bent else name.lower() in _ORIGINALS


def _of_other_lens(folder: Path, is_bent: bool) -> Path | None:
    """A capture that is `folder` or lies below it, of photographs of the other kind of lens; None where there is
    none."""
    return next((each for each in (folder, *folders_below(folder)) if _bends(each) is (not is_bent)), None)


def _bends(capture: Path) -> bool | None:
    """Whether a lens of a COLMAP model or of transforms.json bends; None for other folders, and where nothing can be
    read."""
    try:
        models = find_models(capture)
        if models:
            return any(lens.is_distorted for lens in read_lenses(models[0]))
        if (capture / TRANSFORMS_FILE).is_file():
            views = read_transforms(capture, CaptureOptions(), needs_points=False).views
            return any(view.intrinsics.is_distorted for view in views)
    except (CaptureError, OSError):
        return None
    return None


def _of_other_photographs(root: Path, names: Sequence[str], captures: dict[str, Path], is_bent: bool) -> CaptureError:
    kind = "undistorted photographs" if is_bent else "photographs that are not undistorted"
    lens = "whose lens is bent" if is_bent else "whose lens is a pinhole"
    said = [
        f"{capture} is a capture of such: vdgs run {shell_word(capture)} --output RUN" for capture in captures.values()
    ]
    said += [f"--images {shell_word(name)} if it holds none of such" for name in names if name not in captures]
    return CaptureError(
        f"{root}: no images/ folder, and {' and '.join(names)} beside it is for {kind}, which do not fit this model, "
        f"{lens}. {'; '.join(said)}; or give the photographs that the model is of: --images FOLDER."
    )


def _no_one_folder(root: Path, named: list[str], likely: list[str]) -> CaptureError:
    together = f"; --images . for those of {' and '.join(likely)} together" if _are_apart(root, named, likely) else ""
    options = " or ".join(f"--images {name}" for name in named or ["FOLDER, wherever it is"])
    return CaptureError(
        f"{root}: no images/ folder (nor images_2, images_4, ...). Put the photographs there, or name the folder that "
        f"they are in: {options}{together}."
    )


def _refuse_model_alone(root: Path) -> None:
    """Raise CaptureError where the photographs of a model lie in one of the two folders above it."""
    above = next((folder for folder in root.resolve().parents[:2] if (folder / "images").is_dir()), None)
    if above is None:
        return
    models = {model.resolve() for model in find_models(above)}
    if any(model.resolve() in models for model in find_models(root)):
        give = f"Give the folder of both: {shell_word(above)}"
    else:
        give = f"Say where: vdgs run {shell_word(root)} --images {shell_word(above / 'images')}"
    raise CaptureError(f"{root}: is a model alone; its photographs lie beside it. {give}")


def _are_apart(root: Path, named: list[str], likely: list[str]) -> bool:
    """Whether photographs lie in several folders alone, and each has a name of its own."""
    if len(likely) < 2 or "." in named:
        return False
    stems = [match_stem(name) for folder in likely for name in find_images(root / folder)]
    return len(set(stems)) == len(stems)
