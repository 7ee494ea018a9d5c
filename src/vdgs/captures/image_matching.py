"""Every view with its photograph and its mask, and the camera brought to the size that the photograph has."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vdgs.captures.formats.source_capture import (
    OWN_LENSES,
    SINGLE_FOCAL,
    Intrinsics,
    SourceCapture,
    SourceView,
    format_list,
    refuse_many_missing,
)
from vdgs.captures.image_files import (
    ROUNDING_PX,
    find_images,
    is_turned,
    read_header,
    readable_suffixes,
    same_aspect,
)
from vdgs.captures.mask_matching import check_mask, find_masks
from vdgs.captures.name_resolution import ImageNameIndex, find_in_other_folders, several_places
from vdgs.captures.strays import MASKED, is_undistorted_here, masked_stem
from vdgs.captures.undistortion import ImageFile
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError
from vdgs.system.units import some_names

#: Photographs whose size differs from that of most by more than this share are mentioned; rounding differs by less.
MAX_SIZE_DEVIATION = 0.2
#: Programs that undistort photographs change the sizes of both sides by less than this share, to any number of pixels.
MAX_UNDISTORTED_DEVIATION = 0.1
#: People shrink photographs to widths that are multiples of these numbers of pixels, or by such shares (choice: one
#: undistorted width in ten is, too).
ROUND_PX, ROUND_SHARE = (16, 50), 0.05
#: The same for the shorter side, which people give more rarely: coarser (3840x2160 to 3640x2048; 720, 1080 and 1440).
ROUND_SHORTER_PX = (64, 100, 360)


@dataclass(frozen=True, eq=False)
class MatchedView:
    """A view whose image was found."""

    view: SourceView
    file: ImageFile


def match_images(
    root: Path, source: SourceCapture, options: CaptureOptions, warnings: list[str]
) -> tuple[list[MatchedView], int]:
    """Every view with its image file, and how many images have no camera: these become a warning, and so do some
    cameras without an image. Raises CaptureError where many are missing."""
    folder = root / source.images
    available = ImageNameIndex(_images_in(folder)) if folder.is_dir() else ImageNameIndex({})
    paths = _image_paths(source, folder, available, warnings)
    there = [path.is_file() for path in paths]
    missing = [view.name for view, found in zip(source.views, there, strict=True) if not found]
    several = [*several_places(missing, available.images), *_fuller_folders(root, folder, missing)]
    try:
        warnings += [*refuse_many_missing(missing, len(paths), folder, options.strict), *several]
    except CaptureError as error:
        shrunk = [] if any(there) else _other_names_in_shrunk(source, root, available)
        raise CaptureError("\n".join([str(error), *several, *shrunk])) from None
    views = tuple(view for view, found in zip(source.views, there, strict=True) if found)
    source, paths = replace(source, views=views), [path for path in paths if path.is_file()]
    spare, masks = _without_camera(source, paths)
    if spare:
        shown = some_names(spare)
        warnings.append(f"{len(spare)} images have no camera and are not used ({shown}).")
    photographs = _fitted(root, source, paths, options, warnings)
    warnings += _note_unused(masks, photographs)
    return photographs, len(spare)


def _images_in(folder: Path) -> dict[str, Path]:
    """The images below a folder, as `find_images`, without those in folders of undistorted copies of ours."""
    return {
        name: path for name, path in find_images(folder).items() if "/" not in name or not is_undistorted_here(path)
    }


def _fuller_folders(root: Path, folder: Path, missing: Sequence[str]) -> list[str]:
    """What to give instead of a folder of images, some of which are missing, where another size of them has all."""
    sizes = [each for each in root.glob("images*") if re.fullmatch(r"images(_\d+)?", each.name)] if missing else []
    for other in sorted(each for each in sizes if each.is_dir() and each != folder):
        there = ImageNameIndex(find_images(other))
        if all(there.find(name) for name in missing):
            return [f"{other} has them: --images {other.name} uses all."]
    return []


def _image_paths(source: SourceCapture, folder: Path, available: ImageNameIndex, warnings: list[str]) -> list[Path]:
    """Where the image of each view is, or would be."""
    found_as: Sequence[str | None] = [available.find(view.name) for view in source.views]
    if not any(found_as):
        found_as = find_in_other_folders([view.name for view in source.views], available.images, folder, warnings)
    return [view.image_path or folder / (name or view.name) for view, name in zip(source.views, found_as, strict=True)]


def _without_camera(source: SourceCapture, paths: list[Path]) -> tuple[list[str], dict[str, Path]]:
    """The images in the capture's folders that are not at these paths: those that have no camera, and the masks of
    those that have one. Masked copies are neither."""
    named = set(paths)
    stems = {path.with_suffix("") for path in paths}
    others = {
        name: path
        for folder in source.image_folders
        for name, path in _images_in(folder).items()
        if path not in named and not _is_masked_copy(path, stems)
    }
    masks = {name: path for name, path in others.items() if _is_mask(path, stems)}
    others = {name: path for name, path in others.items() if name not in masks}
    used = {path.resolve() for path in paths} if others else set()  # asked of the disk only where names differ
    return [name for name, path in others.items() if path.resolve() not in used], masks


def _note_unused(masks: dict[str, Path], photographs: Sequence[MatchedView]) -> list[str]:
    """A note about the masks among photographs, by their names, that no photograph has."""
    used = {photo.file.mask.resolve() for photo in photographs if photo.file.mask is not None} if masks else set()
    unused = [name for name, path in masks.items() if path.resolve() not in used]
    if not unused:
        return []
    return [
        f"{len(unused)} images beside photographs are masks by their names and are not used ({some_names(unused)}). "
        "One mask counts of each photograph, first that in a folder of masks; beside x.jpg it is called x_mask.png."
    ]


def _other_names_in_shrunk(source: SourceCapture, root: Path, available: ImageNameIndex) -> list[str]:
    """What to give instead of a folder images_N whose photographs have other names than those of the model, as in sets
    of NeRF (images/IMG_4026.JPG, images_4/image000.png)."""
    whole, _, factor = source.images.rpartition("_")
    if not (whole and factor.isdecimal() and available.images and (root / whole).is_dir()):
        return []
    originals = ImageNameIndex(find_images(root / whole))
    if not any(originals.find(view.name) for view in source.views):
        return []
    first = next(iter(available.images))
    return [f"{source.images} has other names ({first}): give --images {whole} --downscale {factor} instead."]


def _is_masked_copy(path: Path, stems: set[Path]) -> bool:
    """Whether an image is a masked copy (BlendedMVS) of one of those beside it, which are given without suffixes."""
    return path.stem.endswith(MASKED) and path.with_name(path.stem.removesuffix(MASKED)) in stems


def _is_mask(path: Path, stems: set[Path]) -> bool:
    """Whether an image is by its name the mask of one of those beside it, which are given without their suffixes."""
    stem = masked_stem(path.stem) or (path.stem if Path(path.stem).suffix.lower() in readable_suffixes() else None)
    return stem is not None and bool({path.with_name(stem), path.with_name(Path(stem).stem)} & stems)


def _fitted(
    root: Path, source: SourceCapture, paths: list[Path], options: CaptureOptions, warnings: list[str]
) -> list[MatchedView]:
    """The views with their images, masks and intrinsics at the images' sizes; collects what does not fit."""
    photographs, problems = list[MatchedView](), list[str]()
    masks = find_masks(root, source.images, source.views, paths, options, warnings)
    for view, path in zip(source.views, paths, strict=True):
        mask = masks[view.name]
        try:
            intrinsics = fit_to_image(view, path)
            if mask is not None:
                check_mask(mask, path)
            photographs.append(MatchedView(view, ImageFile(view.name, path, mask, intrinsics)))
        except CaptureError as error:
            problems.append(str(error))
    if len(problems) > 1:
        raise CaptureError(f"{root / source.images}: {len(problems)} images cannot be used.{format_list(problems)}")
    if problems:
        raise CaptureError(problems[0])
    warnings += [*_shrunk_otherwise(photographs), *_all_but_whole(photographs)]
    return photographs


def _all_but_whole(photographs: list[MatchedView]) -> list[str]:
    """A warning where photographs of bent lenses are all but as large as their cameras, as undistorted copies are."""
    found = [
        (photo.view.name, *sizes)
        for photo in photographs
        if photo.view.intrinsics.is_distorted
        and _is_all_but_whole(*(sizes := (_size(photo.file.intrinsics), _size(photo.view.intrinsics))))
    ]
    if not found:
        return []
    name, (width, height), (wide, high) = found[0]
    return [
        f"{len(found)} of {len(photographs)} photographs are all but as large as their cameras ({name}: {width}x"
        f"{height}, the camera {wide}x{high}), and are undistorted by the lenses of these. If they are undistorted "
        "copies already, edges will be blurred: give the photographs that the model is of."
    ]


def _size(intrinsics: Intrinsics) -> tuple[int, int]:
    return intrinsics.width, intrinsics.height


def _is_all_but_whole(size: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Whether a photograph's width and height differ from those of its camera by more than rounding, and by little."""
    apart = max(abs(one - other) for one, other in zip(size, camera, strict=True))
    return apart > ROUNDING_PX and apart <= MAX_UNDISTORTED_DEVIATION * max(camera)


def _is_undistorted_size(size: tuple[int, int], camera: tuple[int, int]) -> bool:
    """Whether a photograph is all but as large as its camera, and nobody shrinks photographs to such a size."""
    if not _is_all_but_whole(size, camera):
        return False
    longer, whole = max(size), max(camera)
    by_share = abs(longer - round(longer / whole / ROUND_SHARE) * ROUND_SHARE * whole) < ROUNDING_PX
    is_enlarged = longer > whole or min(size) > min(camera)
    is_round = any(longer % step == 0 for step in ROUND_PX) or any(min(size) % step == 0 for step in ROUND_SHORTER_PX)
    return is_enlarged or not (by_share or is_round)


def _shrunk_otherwise(photographs: list[MatchedView]) -> list[str]:
    """A warning where some photographs are shrunk by another factor than most: thumbnails among the photographs."""
    factors = np.array([photo.file.intrinsics.width / photo.view.intrinsics.width for photo in photographs])
    usual = float(np.quantile(factors, 0.5, method="higher"))  # one of them, whatever their number
    others = np.flatnonzero(np.abs(factors / usual - 1) > MAX_SIZE_DEVIATION)
    if not len(others):
        return []
    names = some_names([photographs[index].view.name for index in others])
    sizes = " to ".join(dict.fromkeys(f"{size:.3g}" for size in (factors[others].min(), factors[others].max())))
    return [
        f"{len(others)} of {len(factors)} photographs are not shrunk as the rest, to {sizes} of the size of "
        f"their cameras instead of {usual:.3g} ({names}). Thumbnails?"
    ]


def fit_to_image(view: SourceView, path: Path) -> Intrinsics:
    """The view's intrinsics at the actual size of its image.

    Shrunk folders hold sizes rounded up or down by at most one pixel; anything else contradicts the model.
    """
    header, intrinsics = read_header(path), view.intrinsics
    if (header.width, header.height) == (intrinsics.width, intrinsics.height):
        return intrinsics
    if not same_aspect((header.width, header.height), (intrinsics.width, intrinsics.height)):
        turned = same_aspect((header.height, header.width), (intrinsics.width, intrinsics.height))
        hint = "The image is turned by a quarter (EXIF orientation applied?). " if turned else ""
        sizes = f"is {header.width}x{header.height}, but its camera is {intrinsics.width}x{intrinsics.height}"
        if turned and is_turned(path):
            raise CaptureError(
                f"{path}: {sizes}, upright: EXIF turns the photograph by a quarter, and vdgs takes its pixels as the "
                "file has them. Give copies that are written upright (magick mogrify -auto-orient)."
            )
        raise CaptureError(
            f"{path}: {sizes}: another shape, so the two do not belong together. {hint}Use the images that the model "
            "was made from, or shrink them evenly."
        )
    if intrinsics.is_distorted and _is_undistorted_size((header.width, header.height), _size(intrinsics)):
        raise CaptureError(
            f"{path}: is {header.width}x{header.height}, but its camera, whose lens is bent, is {intrinsics.width}x"
            f"{intrinsics.height}: as programs leave photographs that they undistort, which would be undistorted once "
            "more. Give the photographs that the model is of, or these with their own model (of COLMAP the folder that "
            "image_undistorter wrote, with images and sparse in it)."
        )
    return scale_intrinsics(intrinsics, header.width, header.height)


def scale_intrinsics(intrinsics: Intrinsics, width: int, height: int) -> Intrinsics:
    """Intrinsics for the same picture at another size; lens distortion parameters do not depend on it."""
    sx, sy = width / intrinsics.width, height / intrinsics.height
    (fx, fy), (cx, cy) = intrinsics.focal, intrinsics.principal_point
    if not intrinsics.is_distorted:
        return Intrinsics("PINHOLE", (fx * sx, fy * sy, cx * sx, cy * sy), width, height)
    head = (fx * (sx + sy) / 2,) if intrinsics.model in SINGLE_FOCAL else (fx * sx, fy * sy)
    tail = intrinsics.params[len(head) + 2 :]
    if intrinsics.model in OWN_LENSES:  # skew and shear are in pixels across and down
        tail = tuple(value * {6: sx, 9: sy}.get(index, 1.0) for index, value in enumerate(tail))
    return Intrinsics(intrinsics.model, (*head, cx * sx, cy * sy, *tail), width, height)
