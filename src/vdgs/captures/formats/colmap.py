"""COLMAP sparse models, binary and text, read with bounds checks.

The reader is our own rather than pycolmap's because a damaged file must end in a message: every count is
held against the bytes that are left before anything is allocated, so truncated or corrupted files can
neither crash the process nor exhaust memory. Layout: https://colmap.github.io/format.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.captures.formats.source import (
    CAMERA_MODELS,
    MODEL_PARAMETERS,
    Intrinsics,
    SourceView,
    check_intrinsics,
    duplicates,
    listing,
    rigid,
    safe_name,
)
from vdgs.errors import CaptureError

QUATERNION_TOLERANCE = 1e-3
LONGEST_NAME = 4096


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model: posed views, points [n, 3] float64 and colours [n, 3] uint8, in its own world."""

    folder: Path
    views: tuple[SourceView, ...]
    points: np.ndarray
    colours: np.ndarray


class _Cursor:
    """Reads little-endian records from a whole file, never past its end."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.data = file.read_bytes()
        self.offset = 0

    @property
    def left(self) -> int:
        return len(self.data) - self.offset

    def fail(self, what: str) -> CaptureError:
        return CaptureError(
            f"{self.file}: {what} at byte {self.offset} of {len(self.data)}. "
            "The file is truncated or damaged; copy or export the COLMAP model again."
        )

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        if self.left < size:
            raise self.fail("the file ends in the middle of a record")
        values = struct.unpack_from("<" + layout, self.data, self.offset)
        self.offset += size
        return values

    def count(self, smallest_record: int, what: str) -> int:
        (count,) = self.take("Q")
        if count * smallest_record > self.left:
            raise self.fail(f"{count} {what} are announced, more than the file can hold,")
        return count

    def skip(self, size: int) -> None:
        if size > self.left:
            raise self.fail("the file ends in the middle of a record")
        self.offset += size

    def name(self) -> str:
        end = self.data.find(b"\0", self.offset, self.offset + LONGEST_NAME)
        if end < 0:
            raise self.fail("an image name does not end")
        raw, self.offset = self.data[self.offset : end], end + 1
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise self.fail(f"an image name is not UTF-8 text ({raw[:40]!r})") from None

    def finish(self) -> None:
        if self.left:
            raise self.fail(f"{self.left} bytes are left over after the last record")


def find_models(root: Path) -> list[Path]:
    """Folders that hold a sparse model: `root`/sparse/N, sparse, colmap/sparse/N, N, or `root` itself."""
    parents = [root / "sparse", root / "colmap" / "sparse", root]
    candidates: list[Path] = []
    for parent in parents:
        if parent.is_dir():
            numbered = [entry for entry in parent.iterdir() if entry.is_dir() and entry.name.isdigit()]
            candidates += [*sorted(numbered, key=lambda entry: int(entry.name)), parent]
    return [folder for folder in candidates if _format(folder) is not None]


def read_colmap(folder: Path) -> ColmapModel:
    """The sparse model in `folder`, binary where present, else text.

    Raises `CaptureError` naming the file if it is missing, truncated, damaged or inconsistent.
    """
    suffix = _format(folder)
    if suffix is None:
        raise CaptureError(f"{folder}: no COLMAP model here (cameras and images, as .bin or .txt).")
    binary = suffix == ".bin"
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    points_file = folder / f"points3D{suffix}"
    try:
        cameras = (_cameras_binary if binary else _cameras_text)(cameras_file)
        records = list((_images_binary if binary else _images_text)(images_file))
        points, colours = _no_points()
        if points_file.is_file():
            points, colours = (_points_binary if binary else _points_text)(points_file)
    except OSError as error:
        raise CaptureError(f"{error.filename or folder}: cannot be read ({error.strerror or error}).") from error
    return ColmapModel(folder, _views(records, cameras, images_file), points, colours)


def count_images(folder: Path) -> int:
    """How many registered images the model announces, without reading it all (-1 if unreadable)."""
    try:
        if _format(folder) == ".bin":
            with (folder / "images.bin").open("rb") as stream:
                return struct.unpack("<Q", stream.read(8))[0]
        return sum(1 for _ in _images_text(folder / "images.txt"))
    except (OSError, struct.error, CaptureError):
        return -1


def _format(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / (stem + suffix)).is_file() for stem in ("cameras", "images")):
            return suffix
    return None


def _no_points() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


@dataclass(frozen=True)
class _ImageRecord:
    quaternion: tuple[float, ...]  # wxyz
    translation: tuple[float, ...]
    camera: int
    name: str


def _views(records: list[_ImageRecord], cameras: dict[int, Intrinsics], file: Path) -> tuple[SourceView, ...]:
    """Posed views in name order; raises on silly poses, unknown cameras and names given twice."""
    orphans = [f"{record.name} (camera {record.camera})" for record in records if record.camera not in cameras]
    if orphans:
        raise CaptureError(
            f"{file}: these images name a camera that is not in the cameras file. "
            f"Both files must come from the same export.{listing(orphans)}"
        )
    views = [
        SourceView(safe_name(record.name, file), _pose(record, file), cameras[record.camera]) for record in records
    ]
    views.sort(key=lambda view: view.name)
    twice = duplicates(view.name for view in views)
    if twice:
        raise CaptureError(f"{file}: the same image name occurs more than once.{listing(twice)}")
    return tuple(views)


def _pose(record: _ImageRecord, file: Path) -> np.ndarray:
    label = f"image {record.name!r}"
    quaternion = np.array(record.quaternion)
    near = np.isfinite(quaternion).all() and np.abs(quaternion).max() < 2  # before squares overflow
    if not near or abs(np.linalg.norm(quaternion) - 1) > QUATERNION_TOLERANCE:
        raise CaptureError(
            f"{file}: {label} has the rotation {record.quaternion}, which is not a unit quaternion. "
            "The file is damaged; copy or export the COLMAP model again."
        )
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
    pose[:3, 3] = record.translation
    return rigid(pose, file, label)


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


# ------------------------------------------------------------------------------------------- binary


def _cameras_binary(file: Path) -> dict[int, Intrinsics]:
    cursor = _Cursor(file)
    cameras: dict[int, Intrinsics] = {}
    for _ in range(cursor.count(24 + 3 * 8, "cameras")):
        identifier, model, width, height = cursor.take("IiQQ")
        if model not in CAMERA_MODELS:
            raise cursor.fail(f"camera {identifier} has the unknown or unsupported model number {model}")
        name, parameters = CAMERA_MODELS[model]
        intrinsics = Intrinsics(name, cursor.take(f"{parameters}d"), width, height)
        _add_camera(cameras, identifier, intrinsics, file)
    cursor.finish()
    return cameras


def _add_camera(cameras: dict[int, Intrinsics], identifier: int, intrinsics: Intrinsics, file: Path) -> None:
    if identifier in cameras:
        raise CaptureError(f"{file}: camera {identifier} occurs twice. Export the COLMAP model again.")
    cameras[identifier] = check_intrinsics(intrinsics, file, f"camera {identifier}")


def _images_binary(file: Path) -> Iterator[_ImageRecord]:
    cursor = _Cursor(file)
    for _ in range(cursor.count(4 + 7 * 8 + 4 + 1 + 8, "images")):
        _, *pose, camera = cursor.take("I7dI")
        name = cursor.name()
        cursor.skip(24 * cursor.count(24, "image points"))
        yield _ImageRecord(tuple(pose[:4]), tuple(pose[4:]), camera, name)
    cursor.finish()


#: Fixed part of a point: id, xyz, rgb, error, track length.
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def _points_binary(file: Path) -> tuple[np.ndarray, np.ndarray]:
    cursor = _Cursor(file)
    size, data = _POINT.itemsize, cursor.data
    count = cursor.count(size, "points")
    buffer = bytearray(count * size)
    offset, end = cursor.offset, len(data)
    for index in range(count):
        after = offset + size
        track_end = after + 8 * int.from_bytes(data[after - 8 : after], "little")
        if after > end or track_end > end:
            cursor.offset = offset
            raise cursor.fail(f"point {index} of {count} runs past the end of the file")
        buffer[index * size : (index + 1) * size] = data[offset:after]
        offset = track_end
    cursor.offset = offset
    cursor.finish()
    records = np.frombuffer(buffer, _POINT)
    return records["xyz"].astype(np.float64), records["rgb"].copy()


# --------------------------------------------------------------------------------------------- text


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without the leading comments."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(stream, 1):
                if not line.startswith("#"):
                    yield number, line.rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise CaptureError(f"{file}: is not UTF-8 text ({error}). Export the COLMAP model again.") from None


def _bad_line(file: Path, number: int, expected: str) -> CaptureError:
    return CaptureError(f"{file}: line {number} should read '{expected}'. The file is damaged; export it again.")


def _cameras_text(file: Path) -> dict[int, Intrinsics]:
    expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
    cameras: dict[int, Intrinsics] = {}
    for number, line in _lines(file):
        words = line.split()
        if not words:
            continue
        try:
            identifier, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            params = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError):
            raise _bad_line(file, number, expected) from None
        if MODEL_PARAMETERS.get(model) != len(params):
            raise CaptureError(
                f"{file}: line {number}: {model!r} with {len(params)} parameters is no camera model that is "
                "supported. "
                f"Supported: {', '.join(MODEL_PARAMETERS)}."
            )
        _add_camera(cameras, identifier, Intrinsics(model, params, width, height), file)
    return cameras


def _images_text(file: Path) -> Iterator[_ImageRecord]:
    """Two lines an image: the pose, then its points (which may be an empty line)."""
    lines = _lines(file)
    for number, line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            _, camera = int(words[0]), int(words[8])
            pose = [float(word) for word in words[1:8]]
            name = words[9].strip()
        except (ValueError, IndexError):
            raise _bad_line(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
        yield _ImageRecord(tuple(pose[:4]), tuple(pose[4:]), camera, name)
        next(lines, None)


def _points_text(file: Path) -> tuple[np.ndarray, np.ndarray]:
    positions: list[list[float]] = []
    colours: list[list[int]] = []
    for number, line in _lines(file):
        words = line.split(maxsplit=8)
        if not words:
            continue
        try:
            position = [float(word) for word in words[1:4]]
            colour = [int(word) for word in words[4:7]]
            float(words[7])
        except (ValueError, IndexError):
            raise _bad_line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
        if not all(0 <= value <= 255 for value in colour):
            raise _bad_line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK[], colours from 0 to 255")
        positions.append(position)
        colours.append(colour)
    if not positions:
        return _no_points()
    return np.array(positions, np.float64), np.array(colours, np.uint8)
