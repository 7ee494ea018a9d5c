"""Captures and models below a folder of photographs, before anyone makes their poses anew."""

from __future__ import annotations

import os
from pathlib import Path, PurePath

from vdgs.captures.capture_root import capture_root
from vdgs.captures.folders_below import folders_below, holds_pictures_alone
from vdgs.captures.foreign_poses import foreign_kind
from vdgs.captures.formats.colmap import count_images, find_models
from vdgs.captures.formats.llff import POSES_FILE, is_llff, read_llff
from vdgs.captures.formats.matrixcity import pose_files, read_matrixcity
from vdgs.captures.formats.mega_nerf import is_mega_nerf
from vdgs.captures.formats.mvsnet import CAMERA_END, is_mvsnet, read_mvsnet
from vdgs.captures.formats.transforms import read_transforms
from vdgs.captures.image_files import readable_suffixes
from vdgs.captures.output_guard import is_capture
from vdgs.captures.project_formats import PROJECTS, find_projects
from vdgs.captures.strays import is_mask_folder, why_not_read
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.quoting import shell_word
from vdgs.system.units import first_names

#: Files beside transforms_train.json, and those of a COLMAP model.
_SET_FILES = {"transforms_train.json", "transforms_test.json", "transforms_val.json"}
_MODEL_STEMS = {"cameras", "images", "points3d", "rigs", "frames"}


def model_below(root: Path) -> str | None:
    """What to say of a capture in a folder below `root`, or of a model without photographs where there is no capture,
    the biggest of several; None where there is neither."""
    found = _captures_below(root)
    if not found:
        return None
    first = next((each for each in found if each[1] != "model"), found[0])
    alike = [folder for folder, kind in found if kind == first[1]]
    best = first[0] if first[1] == "project" else max(alike, key=_size)
    beside = [folder for folder, kind in found if (kind == "model") == (first[1] == "model") and folder != best]
    others = [folder.relative_to(root).as_posix() for folder in beside]
    return _SAID[first[1]](root, best) + (f" (beside it: {first_names(others)}; a run is of one)" if others else "")


def _captures_below(root: Path) -> list[tuple[Path, str]]:
    """Folders below `root` that are captures, those that lie higher first, without what is in them: whether each is a
    `project`, a `capture` with photographs, or a `model` alone."""
    found = list[tuple[Path, str]]()
    for folder in folders_below(root):
        if any(known in folder.parents for known, _ in found) or holds_pictures_alone(folder):
            continue
        if not is_capture(folder):
            continue
        is_whole = "capture" if _has_photographs(folder) else "model"
        found.append((folder, "project" if next(find_projects(folder), None) is not None else is_whole))
    return found


def _size(folder: Path) -> int:
    """How many photographs a capture has: as its model says, else those in its folder."""
    models = find_models(folder)
    return max(map(count_images, models)) if models else _count_images(folder, False)


def _say_of_project(root: Path, folder: Path) -> str:
    name, file = next(find_projects(folder))
    images = "" if _photographs_inside(capture_root(file)) else f" --images {shell_word(root)}"
    return f"{file} is a project of {PROJECTS[name].program}: vdgs run {shell_word(file)}{images} --output RUN"


def _say_of_capture(root: Path, folder: Path) -> str:
    if is_mega_nerf(folder) and _count_images(folder, False) == 0:
        beside = _photographs_beside(root, folder)
        return (
            f"{folder} is a capture of Mega-NeRF without its photographs (train/rgbs, val/rgbs), which lie there "
            "undistorted and by other names. Its copy_images.py puts them there: python scripts/copy_images.py "
            f"--image_path {shell_word(beside) if beside else 'PHOTOGRAPHS'} --dataset_path {shell_word(folder)}; "
            f"then: vdgs run {shell_word(folder)} --output RUN"
        )
    return f"{folder} is a capture: vdgs run {shell_word(folder)}{_images_beside(root, folder)} --output RUN"


def _say_of_model(root: Path, folder: Path) -> str:
    biggest = max(find_models(folder), key=count_images)
    what = f"{biggest} is a COLMAP model of {count_images(biggest)} photographs. To use it"
    inside = _photographs_inside(folder)
    if inside is not None:
        images = inside.relative_to(folder).as_posix()
        return f"{what}: vdgs run {shell_word(folder)} --images {shell_word(images)} --output RUN"
    photographs = _photographs_beside(root, folder)
    link = f"ln -s {shell_word(photographs.resolve())} {shell_word(folder / 'images')}; " if photographs else ""
    return f"{what}, put them beside it as images: {link}vdgs run {shell_word(folder)} --output RUN"


_SAID = {"project": _say_of_project, "capture": _say_of_capture, "model": _say_of_model}


def _images_beside(root: Path, capture: Path) -> str:
    """What a command adds for a capture whose photographs lie beside it in `root`, and not in it: the folder of all
    that it names, as those of train/ and of test/, where there is one, else that of most."""
    images = (path for path in capture.rglob("*") if path.suffix.lower() in readable_suffixes())
    photographs = None if next(images, None) is not None else _photographs_beside(root, capture)
    if photographs is None:
        return ""
    above = [folder for folder in photographs.parents if folder == root or root in folder.parents]
    for strict in (True, False):
        for folder in (None, photographs, *above):
            if _is_readable(
                capture, CaptureOptions(images=None if folder is None else str(folder.absolute()), strict=strict)
            ):
                return f" --images {shell_word(folder)}" if folder is not None else ""
    return f" --images {shell_word(photographs)}"


def _is_readable(capture: Path, options: CaptureOptions) -> bool:
    """Whether the photographs of a data set are found."""
    readers = ((pose_files, read_matrixcity), (is_mvsnet, read_mvsnet), (is_llff, read_llff))
    try:
        next((reader for is_here, reader in readers if is_here(capture)), read_transforms)(capture, options, False)
    except CaptureError:
        return False
    return True


def check_no_foreign_file(path: Path) -> None:
    """Raise CaptureError for a file of another program that is not read, with what is read instead, and for one that is
    a part of a capture, with the folder of this."""
    if not path.is_file():
        return
    whole = _capture_of(path)
    if whole is not None:
        raise CaptureError(f"{path}: is a part of a capture. Give the folder of it all: {shell_word(whole)}")
    what = foreign_kind(path)
    if what:
        raise CaptureError(f"{path}: is {what}.")


def _capture_of(file: Path) -> Path | None:
    """The folder of a capture that a file of poses or points is a part of: of a set's transforms_train.json or cameras,
    or of a COLMAP model; None for other files."""
    folder = file.absolute().parent
    if file.name in _SET_FILES and pose_files(folder):
        return file.parent
    if file.name == POSES_FILE or (file.name.endswith(CAMERA_END) and is_mvsnet(folder.parent)):
        return file.parent if file.name == POSES_FILE else folder.parent
    if file.stem.lower() not in _MODEL_STEMS or folder not in find_models(folder):
        return None
    roots = [root for root in folder.parents[:3] if folder in find_models(root) and _has_photographs(root)]
    return roots[0] if roots else file.parent


def _has_photographs(folder: Path) -> bool:
    if (folder / "transforms.json").is_file() or is_mega_nerf(folder) or pose_files(folder) or is_mvsnet(folder):
        return True
    return is_llff(folder) or any(entry.is_dir() and entry.name.startswith("images") for entry in folder.iterdir())


def _photographs_inside(folder: Path) -> Path | None:
    """The folder with most images in that of a model, itself included."""
    below = [each for each in folders_below(folder) if not any(map(is_mask_folder, each.relative_to(folder).parts))]
    places = [folder, *(each for each in below if why_not_read(each) is None)]
    counts = {place: _count_images(place, True) for place in places}
    best = max(places, key=lambda place: counts[place])
    return best if counts[best] else None


def _photographs_beside(root: Path, model: Path) -> Path | None:
    """The folder with most images beside a model or above it, up to `root`, the nearest first; one that has them in
    folders of its own only where no other has any. Photographs of other captures are none of it."""
    above = [folder for folder in model.parents if folder == root or root in folder.parents]
    for directly in (True, False):
        for level in above:
            beside = [entry for entry in sorted(level.iterdir()) if entry.is_dir() and entry not in (model, *above)]
            beside = [entry for entry in beside if not is_mask_folder(entry.name) and why_not_read(entry) is None]
            counts = {folder: _count_images(folder, directly) for folder in beside if not is_capture(folder)}
            counts |= {level: _count_images(level, directly)} if directly else {}
            best = max(counts, key=lambda folder: counts[folder], default=level)
            if counts.get(best):
                return best
    return None


def _count_images(folder: Path, directly: bool) -> int:
    """How many images lie in a folder, or in it and in those below it that are no captures."""
    count = 0
    for at, folders, files in os.walk(folder):
        count += sum(PurePath(name).suffix.lower() in readable_suffixes() for name in files)
        folders[:] = [] if directly else [name for name in folders if not is_capture(Path(at, name))]
    return count
