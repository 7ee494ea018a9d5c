"""Masks beside photographs: which images are masks, and of which photograph each is."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import cache
from pathlib import Path

from vdgs.captures.image_files import find_images, find_mask, read_header, same_shape
from vdgs.captures.mask_matching import mask_name
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.sfm.image_metadata import Photograph

#: What folders of masks are called, and one of the photographs that they may lie beside, as in captures.
FOLDER, IMAGES = CaptureOptions.masks, "images"


def find_masks(folders: Sequence[Path], files: Collection[Path]) -> tuple[dict[Path, Path | None], list[str]]:
    """The photographs among the images below the folders, each with its mask or None; and what people should know.

    A folder `masks` holds masks of what lies beside it, named like that, or like what lies in `images` beside it. Where
    there is nothing but such folders, their images are photographs.

    Raises CaptureError for a folder of masks none of which is of a photograph.
    """
    places = {file: place for file in files for place in _masks_above(file, folders)}
    photographs = [file for file in files if file not in places]
    if not photographs:
        return dict.fromkeys(files), []
    beside = {place.parent: place for place in places.values()}
    is_folder = cache(Path.is_dir)
    found = dict[Path, Path | None]()
    for file in photographs:
        found[file] = None
        for parent, name in _ways(file, folders):
            place = beside.get(parent, parent / FOLDER)
            if found[file] is None and is_folder(place):
                beside[parent] = place
                found[file] = find_mask(place, name)
    return found, _remarks(sorted(beside.values()), found)


def check_mask(photo: Photograph) -> None:
    """Raise CaptureError where a photograph's mask cannot be read or has another shape than it."""
    if photo.mask is None:
        return
    header = read_header(photo.mask)
    if not any(same_shape((header.width, header.height), size) for size in (photo.stored_size, photo.size)):
        width, height = photo.stored_size
        raise CaptureError(
            f"{photo.mask}: is {header.width}x{header.height}, but its photograph {photo.name} is {width}x{height}: "
            "another shape, so the two do not belong together. Make the mask from this photograph."
        )


def _masks_above(file: Path, folders: Sequence[Path]) -> Iterator[Path]:
    """The folder of masks that a file lies in, below one of those that were named."""
    folder = next(folder for folder in folders if folder in file.parents)
    parts = file.relative_to(folder).parts[:-1]
    for k, part in enumerate(parts):
        if part.lower() == FOLDER:
            yield folder.joinpath(*parts[: k + 1])
            return


def _ways(file: Path, folders: Sequence[Path]) -> Iterator[tuple[Path, str]]:
    """Folders in whose `masks` a photograph's mask may lie, the nearest first, and what it is named like there."""
    above = [folder for folder in folders if folder in file.parents]
    top = min(above, key=lambda folder: len(folder.parts))
    for parent in file.parents:
        name = file.relative_to(parent)
        yield parent, name.as_posix()
        if name.parts[0].lower() == IMAGES and len(name.parts) > 1:
            yield parent, name.relative_to(name.parts[0]).as_posix()
        if parent == top:
            break
    if top.resolve().name.lower() == IMAGES:
        yield top.resolve().parent, file.relative_to(top).as_posix()


def _remarks(places: Sequence[Path], found: dict[Path, Path | None]) -> list[str]:
    """What people should know of these folders of masks; CaptureError where one has no mask of a photograph."""
    used, remarks = {mask for mask in found.values() if mask is not None}, list[str]()
    for place in places:
        spare = [name for name, path in find_images(place).items() if path not in used]
        if spare and not any(place in mask.parents for mask in used):
            example = mask_name(next(iter(found)).name)
            raise CaptureError(
                f"{place}: holds {len(spare)} masks, none of them of a photograph. Name them like the photographs "
                f"({example}; {spare[0]} is there), or rename the folder if these are photographs or not to be used."
            )
        if spare:
            shown = ", ".join(spare[:5]) + (", ..." if len(spare) > 5 else "")
            remarks.append(f"{place}: {len(spare)} masks belong to no photograph and are not used ({shown}).")
    without = [file for file, mask in found.items() if mask is None]
    if used and without:
        remarks.append(
            f"{len(found) - len(without)} of {len(found)} photographs have a mask in {FOLDER}/; the others, such as "
            f"{without[0].name}, count whole."
        )
    return remarks
