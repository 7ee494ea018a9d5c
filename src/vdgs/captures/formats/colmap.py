"""COLMAP sparse models, binary and text, read with bounds checks.

The reader is our own rather than pycolmap's because a damaged file must end in a message: every count is
held against the bytes that are left before anything is allocated, so truncated or corrupted files can
neither crash the process nor exhaust memory. Layout: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PureWindowsPath

import numpy as np

from vdgs.captures.capture import Observations
from vdgs.captures.formats.colmap_binary import read_cameras_binary, read_images_binary, read_points3D_binary
from vdgs.captures.formats.colmap_records import Cameras, ColmapImage, ColmapPoints, empty_points
from vdgs.captures.formats.colmap_text import read_cameras_text, read_images_text, read_points3D_text
from vdgs.captures.formats.lens_projection import pixel_rays
from vdgs.captures.formats.source_capture import (
    BadPose,
    Intrinsics,
    SourceView,
    format_list,
    leave_out_bad_poses,
    one_view_each,
    safe_name,
    to_rigid,
)
from vdgs.errors import CaptureError

QUATERNION_TOLERANCE = 1e-3
#: How the rows of images.txt and of cameras.txt begin: numbers, a quaternion and a translation; a lens and a size.
_IMAGE_ROW, _CAMERA_ROW = re.compile(r"\d+(\s+[-+.\deE]+){7}\s+\d+\s+\S"), re.compile(r"\d+\s+[A-Z_]{3,}\s+\d+\s+\d+")


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model: posed views, points [n, 3] float64 and colors [n, 3] uint8, in its own world."""

    folder: Path
    views: tuple[SourceView, ...]
    points: np.ndarray
    colors: np.ndarray
    notes: tuple[str, ...] = ()
    """What people should know: images that are left out, and why."""


def find_models(root: Path) -> list[Path]:
    """Folders that hold a sparse model: `root`/sparse/N, sparse, colmap/sparse/N, N, or `root` itself."""
    return [folder for folder in _candidates(root) if _format(folder) is not None]


def _candidates(root: Path) -> list[Path]:
    parents = [root / "sparse", root / "colmap" / "sparse", root]
    candidates: list[Path] = []
    for parent in parents:
        if parent.is_dir():
            numbered = sorted((name for name in os.listdir(parent) if name.isdecimal()), key=int)
            candidates += [*filter(Path.is_dir, (parent / name for name in numbered)), parent]
    return candidates


def read_colmap(folder: Path, strict: bool = False) -> ColmapModel:
    """The sparse model in `folder`, binary where present, else text; without the few images whose pose is none.

    Raises `CaptureError` naming the file if it is missing, truncated, damaged or inconsistent.
    """
    suffix = _format(folder)
    if suffix is None:
        raise CaptureError(f"{folder}: no COLMAP model here (cameras and images, as .bin or .txt).")
    binary = suffix == ".bin"
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    points_file = _points_file(folder)
    try:
        cameras = (read_cameras_binary if binary else read_cameras_text)(cameras_file)
        records = list((read_images_binary if binary else read_images_text)(images_file))
        points, of_points = _read_points(points_file, suffix)
    except OSError as error:
        raise CaptureError(f"{error.filename or folder}: cannot be read ({error.strerror or error}).") from error
    views, notes = _views(records, cameras, points, images_file, strict)
    notes += of_points
    return ColmapModel(folder, views, points.positions, points.colors, notes)


def read_lenses(folder: Path) -> list[Intrinsics]:
    """The cameras of the sparse model in `folder` that are sound, without its images. Raises as `read_colmap`."""
    suffix = _format(folder)
    file = folder / f"cameras{suffix}"
    try:
        cameras = (read_cameras_binary if suffix == ".bin" else read_cameras_text)(file).values()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from error
    return [camera for camera in cameras if isinstance(camera, Intrinsics)]


def count_images(folder: Path) -> int:
    """How many registered images the model announces, without reading it all (-1 if unreadable)."""
    try:
        if _format(folder) == ".bin":
            with (folder / "images.bin").open("rb") as stream:
                return struct.unpack("<Q", stream.read(8))[0]
        return sum(1 for _ in read_images_text(folder / "images.txt", with_points=False))
    except (OSError, struct.error, CaptureError):
        return -1


def has_points(folder: Path) -> bool:
    """Whether the model announces points, without reading it all."""
    try:
        file = _points_file(folder)
        if file is None:
            return False
        if file.suffix == ".bin":
            with file.open("rb") as stream:
                return any(stream.read(8))
        with file.open(encoding="utf-8-sig", errors="replace") as lines:
            return any(line.strip() and not line.lstrip().startswith("#") for line in lines)
    except OSError:
        return False


def _read_points(file: Path | None, suffix: str) -> tuple[ColmapPoints, tuple[str, ...]]:
    """The points of a model whose cameras and images end in `suffix`, and what to say of a file of the other kind: one
    that cannot be read is left, for points may come from elsewhere."""
    if file is None:
        return empty_points(), ()
    read = read_points3D_binary if file.suffix == ".bin" else read_points3D_text
    if file.suffix == suffix:
        return read(file), ()
    try:
        return read(file), (f"{file} is used; there is no points3D{suffix}, as of cameras and images.",)
    except CaptureError as error:
        return empty_points(), (f"{error} It is not used; there is no points3D{suffix} beside it.",)


def _points_file(folder: Path) -> Path | None:
    """The points of a model: of the kind of its cameras and images, else of the other, as where some were converted."""
    files = [folder / f"points3D{suffix}" for suffix in (".bin", ".txt")]
    return next((file for file in (files if _format(folder) == ".bin" else files[::-1]) if file.is_file()), None)


def larger_models_beside(root: Path, model: Path) -> list[Path]:
    """Models beside those with numbers (sparse/geo beside sparse/0) that hold more images than `model`, which is read.
    They are not: programs keep models of other steps there."""
    parents = dict.fromkeys(folder.parent for folder in find_models(root) if folder.name.isdecimal())
    beside = (entry for parent in parents for entry in sorted(parent.iterdir()) if not entry.name.isdecimal())
    return [entry for entry in beside if _format(entry) is not None and count_images(entry) > count_images(model)]


def has_both_kinds(folder: Path) -> bool:
    """Whether a folder holds a binary model, which is read, and a text one of the same or of other poses."""
    return all((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt")) and _format(folder) == ".bin"


def partial_model(root: Path) -> str:
    """A sentence about a folder that holds part of a sparse model; empty where there is none."""
    for folder in _candidates(root):
        for suffix in (".bin", ".txt"):
            files = {stem: folder / (stem + suffix) for stem in ("cameras", "images")}
            present = [file for file in files.values() if file.is_file()]
            if len(present) == 1 and _may_be_of_model(present[0]):
                missing = next(file.name for file in files.values() if file not in present)
                return f"{folder} holds {present[0].name} but no {missing} that can be read: copy the whole model. "
    return ""


def _may_be_of_model(file: Path) -> bool:
    """Whether a text begins as COLMAP's, where others call a list of photographs so too (`ls > images.txt`); True for
    other files."""
    if file.suffix != ".txt":
        return True
    try:
        with file.open(encoding="utf-8-sig", errors="replace") as stream:
            lines = [line.strip() for line in islice(stream, 20)]
    except OSError:
        return True
    kind = "image list" if file.stem == "images" else "camera list"
    row = _IMAGE_ROW if file.stem == "images" else _CAMERA_ROW
    first = next((line for line in lines if line and not line.startswith("#")), "")
    return bool(row.match(first)) or any(line.startswith("#") and kind in line.lower() for line in lines)


def _format(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / (stem + suffix)).is_file() for stem in ("cameras", "images")):
            return suffix
    return None


def _views(
    records: list[ColmapImage], cameras: Cameras, points: ColmapPoints, file: Path, strict: bool
) -> tuple[tuple[SourceView, ...], tuple[str, ...]]:
    """Posed views in name order, and notes; raises on many silly poses or names given twice, on unknown cameras, and
    on those in use that cannot be used."""
    orphans = [f"{record.name} (camera {record.camera})" for record in records if record.camera not in cameras]
    if orphans:
        raise CaptureError(
            f"{file}: these images name a camera that is not in the cameras file. "
            f"Both files must come from the same export.{format_list(orphans)}"
        )
    sorted_points = ColmapPoints(*(column[np.argsort(points.point_ids, kind="stable")] for column in points))
    views, bad = list[SourceView](), dict[str, CaptureError]()
    for record in records:
        intrinsics = cameras[record.camera]
        if isinstance(intrinsics, CaptureError):
            raise intrinsics
        sightings = _sightings(record, sorted_points, intrinsics)
        name = safe_name(_below_a_folder(record.name), file)
        try:
            pose = _pose(record, file)
        except BadPose as error:
            bad[name] = error
            continue
        views.append(SourceView(name=name, camera_from_world=pose, intrinsics=intrinsics, observations=sightings))
    views = sorted(one_view_each(views, file, bad), key=lambda view: view.name)
    return tuple(views), tuple(leave_out_bad_poses(bad, len(records), file, strict))


def _below_a_folder(name: str) -> str:
    """A name without what leads out of every folder (a drive, the root, `..`): its photograph is found by the rest."""
    parts = PureWindowsPath(name).parts  # parted by both kinds of slashes
    outside = [k for k, part in enumerate(parts) if part == ".." or PureWindowsPath(part).anchor]
    return "/".join(parts[outside[-1] + 1 :]) if outside else name


def _sightings(record: ColmapImage, points: ColmapPoints, intrinsics: Intrinsics) -> Observations | None:
    """What an image says that it shows, of points sorted by number; None where it says nothing."""
    numbers, pixels = record.observations
    if not len(numbers) or not len(points.point_ids):
        return None
    places = np.searchsorted(points.point_ids, numbers).clip(max=len(points.point_ids) - 1)
    rays = pixel_rays(intrinsics, pixels)
    known = (points.point_ids[places] == numbers) & np.isfinite(rays).all(axis=1)
    known &= np.isfinite(points.positions[places]).all(axis=1)
    return Observations(points.positions[places[known]], rays[known], numbers[known]) if known.any() else None


def _pose(record: ColmapImage, file: Path) -> np.ndarray:
    label = f"image {record.name!r}"
    quaternion = np.array(record.quaternion)
    near = np.isfinite(quaternion).all() and np.abs(quaternion).max() < 2  # before squares overflow
    if not near or abs(np.linalg.norm(quaternion) - 1) > QUATERNION_TOLERANCE:
        raise BadPose(
            f"{file}: {label} has the rotation {record.quaternion}, which is not a unit quaternion. "
            "The file is damaged; copy or export the COLMAP model again."
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
    pose[:3, 3] = record.translation
    return to_rigid(pose, file, label)


def rotation_from_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrix [3, 3] of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
