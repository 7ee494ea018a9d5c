"""COLMAP's binary files (little-endian), read with bounds checks.

Every count is held against the bytes that are left before anything is allocated, so truncated or corrupted files can
neither crash the process nor exhaust memory.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vdgs.captures.formats.colmap_records import (
    Cameras,
    ColmapImage,
    ColmapPoints,
    add_camera,
    sample_observations,
    unsupported_model,
)
from vdgs.captures.formats.source_capture import CAMERA_MODELS, Intrinsics
from vdgs.captures.text_tables import decode_text
from vdgs.errors import CaptureError

MAX_NAME_BYTES = 4096
#: COLMAP's number of a model that is no lens, whose parameters are the width and the height.
_EQUIRECTANGULAR = 17


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
        end = self.data.find(b"\0", self.offset, self.offset + MAX_NAME_BYTES)
        if end < 0:
            raise self.fail("an image name does not end")
        raw, self.offset = self.data[self.offset : end], end + 1
        return decode_text(raw)

    def finish(self) -> None:
        if self.left:
            raise self.fail(f"{self.left} bytes are left over after the last record")


def read_cameras_binary(file: Path) -> Cameras:
    cursor = _Cursor(file)
    cameras: Cameras = {}
    for _ in range(cursor.count(24 + 2 * 8, "cameras")):
        identifier, model, width, height = cursor.take("IiQQ")
        if model == _EQUIRECTANGULAR:
            cursor.take("2d")
            named = f"number {model} (EQUIRECTANGULAR)"
            add_camera(cameras, identifier, unsupported_model(file, f"camera {identifier}", named), file)
            continue
        if model not in CAMERA_MODELS:  # nobody knows how long it is, so that those after it cannot be read
            raise unsupported_model(file, f"camera {identifier}", f"number {model}")
        name, parameters = CAMERA_MODELS[model]
        intrinsics = Intrinsics(name, cursor.take(f"{parameters}d"), width, height)
        add_camera(cameras, identifier, intrinsics, file)
    cursor.finish()
    return cameras


def read_images_binary(file: Path) -> Iterator[ColmapImage]:
    cursor = _Cursor(file)
    for _ in range(cursor.count(4 + 7 * 8 + 4 + 1 + 8, "images")):
        _, *pose, camera = cursor.take("I7dI")
        name = cursor.name()
        count = cursor.count(_IMAGE_POINT.itemsize, "image points")
        shown = np.frombuffer(cursor.data, _IMAGE_POINT, count, cursor.offset)
        cursor.skip(count * _IMAGE_POINT.itemsize)
        yield ColmapImage(
            tuple(pose[:4]), tuple(pose[4:]), camera, name, sample_observations(shown["point"], shown["pixel"])
        )
    cursor.finish()


#: A feature of an image: where, and the number of its point (-1: none).
_IMAGE_POINT = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
#: Fixed part of a point: id, xyz, rgb, error, track length.
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def read_points3D_binary(file: Path) -> ColmapPoints:
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
    return ColmapPoints(records["id"].astype(np.int64), records["xyz"].astype(np.float64), records["rgb"].copy())
