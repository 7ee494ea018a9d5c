"""Masks beside photographs: which images are masks, and of which photograph each is."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np

from vdgs.captures.image_files import (
    decode_image,
    decode_mask,
    find_images,
    find_mask,
    gray_fraction,
    gray_masks_note,
    read_header,
    same_aspect,
)
from vdgs.captures.mask_matching import mask_name, unused_masks_note
from vdgs.captures.strays import MASK_FOLDERS, is_mask_folder, masked_stem
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.sfm.cube_faces import cut_face
from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.picture_colors import looks_visible
from vdgs.sfm.workspace import Workspace
from vdgs.system.atomic_files import write_bytes
from vdgs.system.stop_signals import check_stop_requested

#: What a folder of masks is called, and one of the photographs that it may lie beside, as in captures.
MASK_FOLDER, IMAGE_FOLDER = CaptureOptions.masks, "images"
#: So many masks of a set are looked at before work begins: they come from one program.
_GRAY_SAMPLE = 3


def find_masks(folders: Sequence[Path], files: Collection[Path]) -> tuple[dict[Path, Path | None], list[str]]:
    """The photographs among the images below the folders, each with its mask or None; and what people should know.

    A folder `masks` (`mask`, `_masks`, ...) holds masks of what lies beside it, named like that, or like what lies in
    `images` beside it, or in a folder of any name where no other has a photograph of that name. Where there is nothing
    but such folders, their images are photographs. An image beside a photograph that is called `x_mask`, `mask_x` or
    `x.jpg.png` is its mask too.

    Raises CaptureError for a folder of masks none of which is of a photograph.
    """
    places = {file: place for file in files for place in _masks_above(file, folders)}
    photographs = [file for file in files if file not in places]
    if not photographs:
        return dict.fromkeys(files), []
    adjacent = _beside_photographs(photographs)
    within = defaultdict[Path, set[str]](set)
    for file in photographs:
        for parent, folder, inner in _in_folders_of(file, folders):
            within[(parent / inner).with_suffix("")].add(folder)
    beside = {place.parent: place for place in places.values()}
    is_folder = cache(Path.is_dir)
    found: dict[Path, Path | None] = dict.fromkeys(file for file in photographs if file not in adjacent)
    for file in found:
        for parent, name in _mask_candidates(file, folders, within):
            if parent not in beside:
                beside[parent] = _mask_folder(parent)
            if found[file] is None and is_folder(beside[parent]):
                found[file] = find_mask(beside[parent], name)
    for mask, photograph in adjacent.items():
        found[photograph] = found[photograph] or mask
    return found, _mask_notes(sorted(filter(is_folder, beside.values())), found)


def _mask_folder(parent: Path) -> Path:
    """The folder of masks in a folder by any of its names."""
    return next((parent / name for name in MASK_FOLDERS if (parent / name).is_dir()), parent / MASK_FOLDER)


def _beside_photographs(files: Sequence[Path]) -> dict[Path, Path]:
    """Images that are by their names masks of others in their folder, each with its photograph."""
    by_stem = {(file.parent, file.stem.lower()): file for file in files}
    by_name = {(file.parent, file.name.lower()): file for file in files}
    found = {}
    for file in files:
        stem = (masked_stem(file.stem) or "").lower()
        photograph = by_name.get((file.parent, stem or file.stem.lower())) or by_stem.get((file.parent, stem))
        if photograph is not None and photograph != file:
            found[file] = photograph
    pictures = _in_color([mask for mask in found if masked_stem(mask.stem) is None])
    return {mask: one for mask, one in found.items() if one not in found and mask not in pictures}


def _in_color(files: Sequence[Path]) -> set[Path]:
    """Those that show the colors of eyes, by some of each folder and ending: programs that convert photographs may
    call them `x.JPG.jpg`, too."""
    groups = defaultdict[tuple[Path, str], list[Path]](list)
    for file in files:
        groups[file.parent, file.suffix.lower()].append(file)
    alike = groups.values()
    return {file for each in alike if any(map(looks_visible, _spread(each))) for file in each}


def check_mask(photo: ImageMetadata) -> None:
    """Raise CaptureError where a photograph's mask cannot be read or has another shape than it."""
    if photo.mask is None:
        return
    header = read_header(photo.mask)
    if not any(same_aspect((header.width, header.height), size) for size in (photo.stored_size, photo.size)):
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
        if is_mask_folder(part):
            yield folder.joinpath(*parts[: k + 1])
            return


def _in_folders_of(file: Path, folders: Sequence[Path]) -> Iterator[tuple[Path, str, Path]]:
    """The folders above that of a photograph, nearest first, the folder in each that holds it, and its name there."""
    for parent in file.parents[: file.parents.index(_top(file, folders)) + 1]:
        name = file.relative_to(parent)
        if len(name.parts) > 1:
            yield parent, name.parts[0], name.relative_to(name.parts[0])


def _top(file: Path, folders: Sequence[Path]) -> Path:
    """The highest of the folders that a file lies in."""
    return min((folder for folder in folders if folder in file.parents), key=lambda folder: len(folder.parts))


def _mask_candidates(
    file: Path, folders: Sequence[Path], within: Mapping[Path, Collection[str]]
) -> Iterator[tuple[Path, str]]:
    """Folders in whose `masks` a photograph's mask may lie, the nearest first, and what it is named like there.
    `within` says in which folders of a folder there are photographs of a name."""
    top = _top(file, folders)
    yield file.parent, file.name
    for parent, folder, name in _in_folders_of(file, folders):
        yield parent, file.relative_to(parent).as_posix()
        if folder.lower() == IMAGE_FOLDER or len(within[(parent / name).with_suffix("")]) == 1:
            yield parent, name.as_posix()
    if top.resolve().name.lower() == IMAGE_FOLDER:
        yield top.resolve().parent, file.relative_to(top).as_posix()


def _mask_notes(mask_folders: Sequence[Path], found: dict[Path, Path | None]) -> list[str]:
    """What people should know of these folders of masks; CaptureError where one has no mask of a photograph."""
    used, remarks = {mask for mask in found.values() if mask is not None}, list[str]()
    for place in mask_folders:
        spare = [name for name, path in find_images(place).items() if path not in used]
        if spare and not any(place in mask.parents for mask in used):
            example = mask_name(_named_from(place.parent, found))
            raise CaptureError(
                f"{place}: holds {len(spare)} masks, none of them of a photograph. Name them like the photographs "
                f"({example}; {spare[0]} is there), or rename the folder if these are photographs or not to be used."
            )
        if spare:
            remarks.append(unused_masks_note(place, spare))
    without = [file for file, mask in found.items() if mask is None]
    if used and without:
        remarks.append(
            f"{len(found) - len(without)} of {len(found)} photographs have a mask; the others, such as "
            f"{without[0].name}, count whole."
        )
    return remarks + gray_masks_note(_gray_fractions(sorted(used)))


def _gray_fractions(masks: Sequence[Path]) -> dict[Path, float]:
    """How much of some masks is gray and left out, spread over those that there are; damaged ones are said later."""
    shares = dict[Path, float]()
    for mask in _spread(masks):
        with suppress(CaptureError):
            shares[mask] = gray_fraction(mask)
    return shares


def _spread(masks: Sequence[Path]) -> Sequence[Path]:
    """Some of them from everywhere."""
    return masks[:: max(1, len(masks) // _GRAY_SAMPLE)][:_GRAY_SAMPLE]


def _named_from(folder: Path, photographs: Collection[Path]) -> str:
    """What the first photograph below a folder is called there; of none below it, its own name."""
    first = next((file for file in photographs if folder in file.parents), None)
    return next(iter(photographs)).name if first is None else first.relative_to(folder).as_posix()


def write_upright_masks(workspace: Workspace, photographs: Sequence[ImageMetadata], threads: int) -> None:
    """Fill the work folder with masks of upright photographs, for those of which something is left out. What is there
    is kept. Raises CaptureError for a mask that cannot be decoded."""
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(partial(_write_one, workspace), [photo for photo in photographs if photo.may_be_masked]):
            check_stop_requested()


def read_keep_mask(metadata: ImageMetadata) -> np.ndarray | None:
    """What counts of a photograph once it is upright, [h, w] bool; None: all of it.

    A mask is of the file as it is, before EXIF's orientation, unless only the upright photograph has its shape. Of a
    view that was cut out of a panorama it is the panorama's.
    """
    if metadata.face:
        width, height = metadata.whole_size
        keep = read_keep_mask(replace(metadata, face="", width=width, height=height))
        nearest = cv2.INTER_NEAREST
        return None if keep is None else cut_face(keep.astype(np.uint8), metadata.face, metadata.width, nearest) > 0
    keep = _opaque(metadata) if metadata.has_alpha_channel else None
    if metadata.mask is None:
        return keep
    header = read_header(metadata.mask)
    if same_aspect((header.width, header.height), metadata.stored_size):
        masked = apply_orientation(decode_mask(metadata.mask, *metadata.stored_size), metadata.orientation)
    else:
        masked = decode_mask(metadata.mask, *metadata.size)
    return masked if keep is None else masked & keep


def _opaque(photo: ImageMetadata) -> np.ndarray | None:
    try:
        opaque = decode_image(photo.path)[1]
    except CaptureError:  # the search of features leaves damaged photographs out
        return None
    return None if opaque is None else apply_orientation(opaque, photo.orientation)


def apply_orientation(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels [h, w, ...] of a file turned and mirrored as EXIF's orientation says."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    down, across = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return pixels[:: -1 if down else 1, :: -1 if across else 1]


def _write_one(workspace: Workspace, photo: ImageMetadata) -> None:
    check_stop_requested()
    target = workspace.mask(photo.name)
    if target.is_file():
        return
    keep = read_keep_mask(photo)
    if keep is not None:
        write_bytes(target, encode_mask(keep))


def encode_mask(keep: np.ndarray) -> bytes:
    """A mask [h, w] bool as a file: white is kept."""
    return cv2.imencode(".png", keep.astype(np.uint8) * 255)[1].tobytes()


def undistort_mask(mask: Path, grid: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask as its photograph becomes without distortion, [h, w] bool: of pixels that are shrunk together only those
    of which all is kept, so that what is masked does not bleed in."""
    pixels = decode_image(mask)[0][..., 0]
    straight = cv2.remap(pixels, grid[..., 0], grid[..., 1], cv2.INTER_NEAREST, borderValue=(0.0,))
    if straight.shape[1::-1] != size:
        straight = cv2.resize(straight.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return straight >= 255 * (1 - 1e-4)
