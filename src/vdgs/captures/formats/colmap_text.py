"""COLMAP's text files: one record a line, two for an image."""

from __future__ import annotations

import codecs
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vdgs.captures.formats.colmap_records import (
    Cameras,
    ColmapImage,
    ColmapPoints,
    add_camera,
    empty_points,
    sample_observations,
    unsupported_model,
)
from vdgs.captures.formats.source_capture import MODEL_PARAMETERS, Intrinsics
from vdgs.captures.text_tables import decode_text, float_or_nan
from vdgs.errors import CaptureError

#: How far from 1 the length of a quaternion may be, as programs round it.
_UNIT_TOLERANCE = 1e-3


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments, each as by `decode_text`: names of photographs may be in Windows' Latin."""
    with file.open("rb") as stream:
        wide = stream.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    encoding, errors = ("utf-16", "replace") if wide else ("utf-8-sig", "surrogateescape")
    with file.open(encoding=encoding, errors=errors) as stream:
        for number, line in enumerate(stream, 1):
            if not line.lstrip().startswith("#"):
                plain = line if wide or line.isascii() else decode_text(line.encode("utf-8", "surrogateescape"))
                yield number, plain.rstrip("\r\n")


def _bad_line(file: Path, number: int, expected: str) -> CaptureError:
    return CaptureError(f"{file}: line {number} should read '{expected}'. The file is damaged; export it again.")


def _whole(word: str) -> int:
    """A whole number, such as `240` or, as some programs write sizes, `240.0`. ValueError for anything else."""
    number = float(word)
    if not number.is_integer():
        raise ValueError(word)
    return int(number)


def read_cameras_text(file: Path) -> Cameras:
    expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
    cameras: Cameras = {}
    for number, line in _lines(file):
        words = line.split()
        if not words:
            continue
        try:
            identifier, model, width, height = int(words[0]), words[1], _whole(words[2]), _whole(words[3])
            params = tuple(float(word) for word in words[4:])
        except (ValueError, IndexError):
            raise _bad_line(file, number, expected) from None
        camera: Intrinsics | CaptureError = Intrinsics(model, params, width, height)
        if MODEL_PARAMETERS.get(model) != len(params):
            camera = unsupported_model(file, f"line {number}", f"{model!r} with {len(params)} parameters")
        add_camera(cameras, identifier, camera, file)
    return cameras


def read_images_text(file: Path, with_points: bool = True) -> Iterator[ColmapImage]:
    """Two lines an image: the pose, then its points (which may be an empty line, or missing)."""
    lines = _lines(file)
    following: tuple[int, str] | None = None
    while (each := following or next(lines, None)) is not None:
        (number, line), following = each, None
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        try:
            _, camera = int(words[0]), int(words[8])
            pose = [float_or_nan(word) for word in words[1:8]]
            name = words[9].strip()
        except (ValueError, IndexError):
            raise _bad_line(file, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
        shown = next(lines, (number + 1, ""))
        if _is_pose(shown[1]):
            following, shown = shown, (number, "")
        triples = _triples(file, *shown) if with_points else np.zeros((0, 3))
        yield ColmapImage(
            tuple(pose[:4]), tuple(pose[4:]), camera, name, sample_observations(triples[:, 2], triples[:, :2])
        )


def _is_pose(line: str) -> bool:
    """Whether a line is the pose of another image, which ends in a name, where points are expected. Where the name is a
    number too, a quaternion of length 1 says so, and that the line has no three numbers for each point."""
    words = line.split(maxsplit=9)
    if len(words) < 10 or not (words[0].isdecimal() and words[8].isdecimal()):
        return False
    name = words[9].split()
    try:
        quaternion, _ = [float_or_nan(word) for word in words[1:5]], [float_or_nan(word) for word in words[5:8]]
        float(name[0])
    except ValueError:
        return True
    if not abs(math.hypot(*quaternion) - 1.0) < _UNIT_TOLERANCE:
        return False
    try:
        return len([float(word) for word in name]) % 3 != 0
    except ValueError:
        return True


def _triples(file: Path, number: int, line: str) -> np.ndarray:
    """The features of an image, [m, 3]: x, y and the number of the point."""
    try:
        return np.array(line.split(), np.float64).reshape(-1, 3)
    except ValueError:
        raise _bad_line(file, number, "POINTS2D[] as (X, Y, POINT3D_ID)") from None


def read_points3D_text(file: Path) -> ColmapPoints:
    numbers: list[float] = []
    positions: list[list[float]] = []
    colors: list[list[int]] = []
    for number, line in _lines(file):
        words = line.split(maxsplit=8)
        if not words:
            continue
        try:
            identifier, position = float(words[0]), [float(word) for word in words[1:4]]
            color = [_whole(word) for word in words[4:7]]
            float(words[7])
        except (ValueError, IndexError):
            raise _bad_line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
        if not all(0 <= value <= 255 for value in color):
            raise _bad_line(file, number, "POINT3D_ID X Y Z R G B ERROR TRACK[], colors from 0 to 255")
        numbers.append(identifier)
        positions.append(position)
        colors.append(color)
    if not positions:
        return empty_points()
    return ColmapPoints(np.array(numbers, np.float64), np.array(positions, np.float64), np.array(colors, np.uint8))
