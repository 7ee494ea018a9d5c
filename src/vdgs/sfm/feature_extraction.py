"""Cameras and features: photographs brought upright, one camera for each kind, their features in COLMAP's database."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps
from rich.console import Console

from vdgs.captures.image_files import decode_image
from vdgs.captures.jpeg import with_end
from vdgs.captures.pillow_limits import pillow_without_limits
from vdgs.config.sfm_options import SfmOptions
from vdgs.errors import CaptureError
from vdgs.sfm.focal_length import lens_numbers
from vdgs.sfm.image_list import ExcludedImage
from vdgs.sfm.image_metadata import FISHEYE, RADIAL, ImageMetadata
from vdgs.sfm.mask_files import apply_orientation
from vdgs.sfm.panoramas import cut_view, read_panorama
from vdgs.sfm.workspace import Workspace, call_cancellable, report_progress
from vdgs.system.atomic_files import write_bytes, write_image
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.stop_signals import check_stop_requested

#: A focal length over the longer side where nothing says one: COLMAP's own guess.
DEFAULT_FOCAL_FACTOR = 1.2
#: The same for a fisheye: 72° from the middle to the ends of the longer side.
FISHEYE_FOCAL_FACTOR = 0.4
#: Photographs of fewer pixels of their longer side, and all where there are so few, are searched at twice their size:
#: three times the work, half as many points again.
UPSAMPLE_BELOW_PX, UPSAMPLE_BELOW_IMAGES = 1200, 40
#: Photographs that one call searches, for each thread: between two calls work can stop.
IMAGES_PER_THREAD = 2
#: What a feature takes in the database: descriptor, place, and what SQLite adds.
BYTES_PER_FEATURE = 160
#: Photographs with fewer features cannot be matched.
MIN_FEATURES = 100
_UPRIGHT_QUALITY = 97
#: What is said of photographs that COLMAP cannot read.
UNDECODABLE = "cannot be decoded: copy it again"
#: Their ends were looked at with their heads.
_JPEGS = (".jpg", ".jpeg")


@dataclass(frozen=True, kw_only=True)
class CameraGroup:
    """Photographs that one camera took: the same maker, serial number, size and focal length."""

    camera: str
    width: int
    height: int
    focal_px: float
    has_focal_prior: bool
    """Whether something says the focal length."""
    source: str
    images: tuple[ImageMetadata, ...]
    model: str = RADIAL
    """COLMAP's model of the lens."""
    is_confirmed: bool = True
    """False where one tag alone says the focal length."""


def group_by_camera(photographs: Sequence[ImageMetadata]) -> list[CameraGroup]:
    """Photographs by the cameras that they share, in the order of their first names; their numbers are 1, 2, ..."""
    alike: dict[tuple[object, ...], list[ImageMetadata]] = {}
    for photo in photographs:
        focal = round(photo.lens.focal, 4) if photo.lens else None
        key = (photo.camera, photo.size, focal, photo.camera_model, photo.face or photo.sensor)
        alike.setdefault(key, []).append(photo)
    groups: dict[tuple[object, ...], list[ImageMetadata]] = {}
    for shared, members in alike.items():
        lenses = lens_numbers([None if photo.lens else photo.focal_mm for photo in members])
        for photo, number in zip(members, lenses, strict=True):
            groups.setdefault((*shared, number), []).append(photo)
    kinds = []
    for members in groups.values():
        first = members[0]
        lens, longer = first.lens, max(first.width, first.height)
        guess = FISHEYE_FOCAL_FACTOR if first.camera_model == FISHEYE else DEFAULT_FOCAL_FACTOR
        focal_px = (lens.focal if lens else guess) * longer
        source = lens.source if lens else "a guess"
        kinds.append(
            CameraGroup(
                camera=f"{first.camera}, {first.sensor.rstrip('/')}" if first.sensor else first.camera,
                width=first.width,
                height=first.height,
                focal_px=focal_px,
                has_focal_prior=bool(lens),
                source=source,
                images=tuple(members),
                model=first.camera_model,
                is_confirmed=lens is None or lens.confirmed,
            )
        )
    return kinds


def prepare_images(
    workspace: Workspace, photographs: Sequence[ImageMetadata], threads: int, console: Console
) -> list[ExcludedImage]:
    """As `write_upright_images`, with the progress where photographs are to be decoded, which takes long."""
    if not any(_is_decoded(photo) and not (workspace.images / photo.name).exists() for photo in photographs):
        return write_upright_images(workspace, photographs, threads)
    with report_progress(workspace, console, "features", len(photographs), "decoded, ") as tell:
        return write_upright_images(workspace, photographs, threads, tell)


def write_upright_images(
    workspace: Workspace,
    photographs: Sequence[ImageMetadata],
    threads: int,
    tell: Callable[[int], object] = lambda _done: None,
) -> list[ExcludedImage]:
    """Fill the work folder with links to the photographs, upright copies of those that EXIF says lie, and JPEGs in sRGB
    of those of other kinds.

    Returns those that could not be decoded, in the order of their files. Photographs themselves are never changed.
    CaptureError where the disk does not tell their names apart.
    """
    _check_names(workspace, photographs)
    of_file: dict[Path, list[ImageMetadata]] = {}
    for photo in sorted(photographs, key=lambda photo: str(photo.path)):
        of_file.setdefault(photo.path, []).append(photo)
    failed, done = list[ExcludedImage](), 0
    tell(done)
    with ThreadPoolExecutor(threads) as pool:
        for members, lost in zip(
            of_file.values(), pool.map(partial(_prepare, workspace), of_file.values()), strict=True
        ):
            check_stop_requested()
            failed += lost
            done += len(members)
            tell(done)
    return failed


def _is_decoded(photo: ImageMetadata) -> bool:
    """Whether a photograph is decoded to be prepared; others are linked, or copied as they are."""
    is_jpeg = photo.path.suffix.lower() in _JPEGS
    return bool(photo.kind or photo.face or photo.orientation != 1 or not is_jpeg)


def _check_names(workspace: Workspace, photographs: Sequence[ImageMetadata]) -> None:
    """Raise CaptureError for names that differ in upper and lower case alone, where the disk takes these for one."""
    alike: dict[str, list[str]] = {}
    for photo in photographs:
        alike.setdefault(photo.name.lower(), []).append(photo.name)
    twins = next((names for names in alike.values() if len(names) > 1), None)
    if twins and workspace.path.is_dir() and (workspace.path.parent / workspace.path.name.swapcase()).is_dir():
        raise CaptureError(
            f"{workspace.path.parent}: this disk takes {twins[0]} and {twins[1]} for one file. Rename one of these "
            "photographs, or take an output on another disk."
        )


def _prepare(workspace: Workspace, photographs: Sequence[ImageMetadata]) -> list[ExcludedImage]:
    """Links or copies of the photographs of one file, several where it is a panorama; those that cannot be decoded."""
    failed, panorama = list[ExcludedImage](), cache(partial(read_panorama, photographs[0]))
    for photo in photographs:
        check_stop_requested()
        target = workspace.images / photo.name
        if target.exists():
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)  # a link that leads nowhere
        if photo.orientation == 1 and not photo.whole and not photo.kind and not photo.face:
            write_bytes(target, with_end(photo.path).read())
            continue
        try:
            if photo.face:
                _save(Image.fromarray(cut_view(photo, panorama())), target, "JPEG")
            elif photo.kind:
                upright = apply_orientation(decode_image(photo.path)[0], photo.orientation)
                _save(Image.fromarray(np.ascontiguousarray(upright)), target, "JPEG")
            elif photo.orientation == 1:
                if photo.path.suffix.lower() not in _JPEGS:
                    decode_image(photo.path)  # of a damaged file COLMAP uses what it can read, and the rest is black
                os.symlink(photo.path.resolve(), target)
            else:
                _write_upright(photo, target)
        except CaptureError as error:
            failed.append(ExcludedImage(photo.name, str(error).removeprefix(f"{photo.path}: ")))
        except (OSError, SyntaxError, ValueError) as error:
            failed.append(ExcludedImage(photo.name, f"cannot be decoded ({error}): copy it again"))
    return failed


def _write_upright(photo: ImageMetadata, target: Path) -> None:
    if photo.path.suffix.lower() not in _JPEGS:
        upright = np.ascontiguousarray(apply_orientation(decode_image(photo.path)[0], photo.orientation))
        kind = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}.get(target.suffix.lower(), "JPEG")
        _save(Image.fromarray(upright), target, kind)
        return
    with pillow_without_limits(), Image.open(photo.path if photo.whole else with_end(photo.path)) as image:
        _save(ImageOps.exif_transpose(image).convert("RGB"), target, "JPEG")


def _save(upright: Image.Image, target: Path, kind: str) -> None:
    options = {"quality": _UPRIGHT_QUALITY, "subsampling": 0} if kind == "JPEG" else {}
    write_image(target, upright, kind, **options)


def create_database(workspace: Workspace, camera_groups: Sequence[CameraGroup]) -> None:
    """The database with one camera for each kind of photographs, unless it is there."""
    workspace.path.mkdir(parents=True, exist_ok=True)
    with workspace.open_database() as database:
        if database.num_cameras() == len(camera_groups):
            return
        database.clear_all_tables()
        for kind in camera_groups:
            camera = pycolmap.Camera.create_from_model_name(0, kind.model, kind.focal_px, kind.width, kind.height)
            camera.has_prior_focal_length = kind.has_focal_prior
            number = database.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
            database.write_rig(rig)


def extract_features(
    workspace: Workspace, camera_groups: Sequence[CameraGroup], options: SfmOptions, threads: int, console: Console
) -> dict[str, int]:
    """Features of all photographs into the database; those that are there already are kept. Returns their numbers."""
    names = [photo.name for group in camera_groups for photo in group.images]
    count, there = sum((workspace.images / name).exists() for name in names), count_features(workspace)
    with report_progress(workspace, console, "features", count) as tell:
        extract_groups(workspace, camera_groups, options, count, threads, there, tell)
    return count_features(workspace)


def extract_groups(
    workspace: Workspace,
    camera_groups: Sequence[CameraGroup],
    options: SfmOptions,
    count: int,
    threads: int,
    there: Collection[str] = (),
    tell: Callable[[int], object] = lambda _done: None,
) -> None:
    """Features of some of `count` photographs, but for those that are `there`, searched as all are. `tell` is called
    with how many are done."""
    present = [[photo.name for photo in each.images if (workspace.images / photo.name).exists()]
               for each in camera_groups]  # fmt: skip
    done = sum(name in there for names in present for name in names)
    tell(done)
    for number, (group, names) in enumerate(zip(camera_groups, present, strict=True), 1):
        fine = is_upsampled(max(group.width, group.height), options.max_image_size, count)
        for masked in (False, True):  # COLMAP takes masks for all photographs of a call, or for none
            missing = [name for name in names if name not in there and workspace.mask(name).exists() == masked]
            for start in range(0, len(missing), IMAGES_PER_THREAD * threads):
                chunk = missing[start : start + IMAGES_PER_THREAD * threads]
                workspace.check_room(len(chunk) * options.max_num_features * BYTES_PER_FEATURE)
                _extract(workspace, chunk, masked, number, fine, options, threads)
                done += len(chunk)
                tell(done)


def searched_megapixels(photographs: Sequence[ImageMetadata], options: SfmOptions) -> float:
    """Megapixels of all photographs at the size of the search, times three for a fine search."""
    total = 0.0
    for photo in photographs:
        longer = max(photo.width, photo.height)
        fine = 3 if is_upsampled(longer, options.max_image_size, len(photographs)) else 1
        total += fine * photo.width * photo.height * min(1.0, options.max_image_size / longer) ** 2
    return total / 1e6


def is_upsampled(longer_side: int, max_image_size: int, count: int) -> bool:
    """Whether photographs of this size, so many in all, are searched at twice their size."""
    return min(longer_side, max_image_size) < UPSAMPLE_BELOW_PX or count <= UPSAMPLE_BELOW_IMAGES


def _extract(
    workspace: Workspace, names: list[str], masked: bool, camera: int, fine: bool, options: SfmOptions, threads: int
) -> None:
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.existing_camera_id = camera
    if masked:
        reader.mask_path = workspace.masks
    extraction.num_threads, extraction.max_image_size, extraction.use_gpu = threads, options.max_image_size, False
    extraction.sift.first_octave, extraction.sift.max_num_features = -1 if fine else 0, options.max_num_features
    call_cancellable(
        pycolmap.extract_features, workspace.database, workspace.images, names, reader_options=reader,
        extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip


def count_features(workspace: Workspace) -> dict[str, int]:
    """Numbers of features by the names of photographs in the database."""
    with workspace.open_database() as database:
        return {
            image.name: database.num_keypoints_for_image(image.image_id)
            for image in database.read_all_images()
            if database.exists_keypoints(image.image_id)
        }


def images_without_features(
    photographs: Sequence[ImageMetadata], counts: dict[str, int], failed: Sequence[ExcludedImage] = ()
) -> list[ExcludedImage]:
    """Photographs that could not be decoded (`failed`, which says why, or by COLMAP), or show nearly nothing (outside
    their masks)."""
    reasons, found = {each.name: each for each in failed}, []
    for photo in photographs:
        count = counts.get(photo.name)
        if photo.name in reasons:
            found.append(reasons[photo.name])
        elif count is None:
            found.append(ExcludedImage(photo.name, UNDECODABLE))
        elif count < MIN_FEATURES:
            where = " where its mask is white" if photo.may_be_masked else ""
            found.append(ExcludedImage(photo.name, f"shows only {count} features{where}: blurred, dark, sky or water?"))
    if len(photographs) - len(found) < 3:
        raise CaptureError(
            f"{len(photographs) - len(found)} of {len(photographs)} photographs show enough to be matched; a scene "
            f"needs 3. The first: {found[0].name} {found[0].reason.rstrip('.')}."
        )
    return found
