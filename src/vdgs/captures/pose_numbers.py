"""Poses in texts, JSON and arrays of any program, told by their numbers: rotations and unit quaternions beside places.

Nothing in a file can run: arrays are read without pickle.
"""

from __future__ import annotations

import math
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import IO

import numpy as np

from vdgs.captures.column_headings import read_heading
from vdgs.captures.flight_extent import NO_LAND_DEG
from vdgs.captures.image_suffixes import IMAGE_SUFFIXES
from vdgs.captures.pose_texts import are_quaternions
from vdgs.captures.table_columns import number_of

#: Rotations are exact to so much, as few decimals leave them.
_TOLERANCE = 1e-3
#: Fewer rows that fit may be chance; a text has no more lines of headings, and no more words in a row (choices).
_MIN_ROWS, _HEADING_LINES, _MOST_WORDS = 3, 4, 60
#: Numbers of a row with a quaternion: a place, perhaps a moment or a number in front, and one or two behind.
_WITH_QUATERNION = (7, 10)
#: A column of a quaternion that is smaller than this (share of 1) in all rows may be no part of it.
_SMALL = 0.03
#: No flight is wider, in degrees, so far as the beginning of its table shows it (choice).
_FLIGHT_DEG = 0.02
#: Headings of what is measured in three axes and is no place.
_NO_PLACE = re.compile(r"vel|acc|gyr|rate|speed|mag|ang|force|bias|^[agvwm]_?[xyz]$", re.IGNORECASE)
_NUMBER = r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?"
_LIST = rf"\[\s*{_NUMBER}(?:\s*,\s*{_NUMBER}){{2,15}}\s*\]"
#: Lists of 12 or 16 numbers, and three or four of three or four.
_FLAT = re.compile(_LIST)
_NESTED = re.compile(rf"\[\s*({_LIST}(?:\s*,\s*{_LIST}){{2,3}})\s*\]")
#: Keys of lenses: with one of them a single matrix is a pose.
_LENS = re.compile(r"focal|fl_x|\"fx\"|intrinsic|principal|camera_matrix", re.IGNORECASE)
#: 3D Tiles place their tiles by matrices, and paths for films are of no photographs.
_NO_POSES = re.compile(r"\"geometricError\"|\"render_height\"|\"camera_path\"|\"keyframes\"", re.IGNORECASE)
#: How arrays of poses are called in an archive of NumPy.
_ARRAY = re.compile(r"(cam(era)?s?_?)?(pose|extrinsic|c2w|w2c|cam2world|world2cam|camera_to_world)s?(_\w+)?", re.I)
#: What damaged and strange files raise.
_BAD_ARRAY = (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)


def has_matrices(path: str, text: str) -> bool:
    """Rows with a rotation matrix and a place, whatever is in front and behind."""
    return _matrices(_Rows(text).numbers)


def has_quaternions(path: str, text: str) -> bool:
    """Rows with a place and a quaternion, in any order, with names or numbers in front or behind."""
    rows = _Rows(text)
    return _quaternions(rows.numbers, rows.headings)


def has_angles(path: str, text: str) -> bool:
    """Rows of UrbanScene3D: a photograph, x, y, z, pitch, 0, yaw, wider than degrees of a flight are."""
    rows = _Rows(text)
    if rows.numbers.shape[1:] != (6,) or PurePath(rows.first).suffix.lower() not in IMAGE_SUFFIXES:
        return False
    x, y, _, pitch, roll, yaw = rows.numbers.T
    is_turn = not roll.any() and (pitch <= 0).all() and (pitch >= -90).all() and (np.abs(yaw) <= 360).all()
    return bool(is_turn and pitch.any() and np.ptp(yaw) > 1 and min(np.ptp(x), np.ptp(y)) > 1)


def has_json_poses(path: str, text: str) -> bool:
    """Several different rigid motions, as lists of lists or of 12 or 16 numbers, or one with a lens."""
    if _NO_POSES.search(text):
        return False
    nests = [[_numbers_of(row) for row in _FLAT.findall(nest)] for nest in _NESTED.findall(text)]
    found = [np.array(rows) for rows in nests if {*map(len, rows)} in ({3}, {4})]
    flat = [_numbers_of(each) for each in _FLAT.findall(text)]
    found += [np.array(each).reshape(-1, 4) for each in flat if len(each) in (12, 16)]
    turned = [each[:3, :3] for each in found if _are_rotations(each[None, :3, :3]) and _is_turned(each)]
    turns = {turn.round(6).tobytes() for turn in turned}
    return len(turns) > 1 or (len(turns) == 1 and bool(_LENS.search(text)))


def has_array_poses(file: Path) -> bool:
    """Whether a file of NumPy holds a motion of each photograph: an array of them, or in an archive one by its name."""
    try:
        return _has_named_array(file) if file.suffix.lower() == ".npz" else _is_array_of_poses(file)
    except _BAD_ARRAY:
        return False


class _Rows:
    """The rows of a text below its headings that have as many words each, and numbers in the same columns."""

    def __init__(self, text: str) -> None:
        lines = [line.strip(" \t,;[]()\r") for line in text.splitlines() if not line.lstrip().startswith(("#", "//"))]
        words = [re.split(r"[\s,;]+", line) for line in lines if line][: 100 + _HEADING_LINES]
        self.numbers, self.first, self.headings = np.zeros((0, 0)), "", list[str]()
        """The longest run of columns of numbers, [n, k]; the first word of the first row; headings of the run."""
        if len(words) < _MIN_ROWS or len(words[-1]) > _MOST_WORDS:
            return
        kinds = [tuple(math.isfinite(number_of(word)) for word in row) for row in words]
        start = next((k for k in range(_HEADING_LINES + 1) if set(kinds[k:]) == {kinds[-1]}), None)
        if start is None or len(words) - start < _MIN_ROWS or kinds[-1].count(False) > _HEADING_LINES:
            return
        first, last = _longest_run(kinds[-1])
        self.numbers = np.array([[number_of(word) for word in row[first:last]] for row in words[start:]])
        self.first = words[start][0]
        if start and len(words[start - 1]) == len(words[-1]):
            self.headings = words[start - 1][first:last]


def _longest_run(are_numbers: Sequence[bool]) -> tuple[int, int]:
    """Where the longest run of true values begins and ends."""
    runs, first = [(0, 0)], None
    for k, is_number in enumerate((*are_numbers, False)):
        first = k if is_number and first is None else first
        if not is_number and first is not None:
            runs.append((first, k))
            first = None
    return max(runs, key=lambda run: run[1] - run[0])


def _matrices(numbers: np.ndarray) -> bool:
    """Whether rows [n, k] have a rotation in the same columns, as a matrix of 3 x 4 or 4 x 4 or 3 x 3 beside a place,
    and not always the same one."""
    count, width = numbers.shape
    if count < 2:
        return False
    for k in range(width - 11):
        block = numbers[:, k : k + 12]
        whole = [block.reshape(-1, 3, 4)[:, :, :3], block[:, :9].reshape(-1, 3, 3), block[:, 3:].reshape(-1, 3, 3)]
        if any(_are_rotations(each) and np.ptp(each, axis=0).max() > _TOLERANCE for each in whole):
            return True
    return False


def _quaternions(numbers: np.ndarray, headings: Sequence[str]) -> bool:
    """Whether rows [n, k] have a quaternion that changes beside a place that does. Normals of points are none: with a
    column of another kind, which is small or 0, they are as long. Nor are what sensors of motion say, by `headings`."""
    count, width = numbers.shape
    if count < _MIN_ROWS or not _WITH_QUATERNION[0] <= width <= _WITH_QUATERNION[1]:
        return False
    return any(_is_quaternion(numbers, k, headings) for k in range(width - 3))


def _is_quaternion(numbers: np.ndarray, k: int, headings: Sequence[str]) -> bool:
    turns = numbers[:, k : k + 4]
    small = (np.abs(turns) < _SMALL).all(axis=0)
    if not are_quaternions(turns) or np.ptp(turns, axis=0).max() < _TOLERANCE or small.sum() in (1, 3):
        return False
    starts = [start for start in (k - 3, k + 4) if start >= 0 and start + 3 <= numbers.shape[1]]
    return any(
        _are_places(numbers[:, start : start + 3]) and all(map(_may_be_place, headings[start : start + 3]))
        for start in starts
    )


def _are_places(places: np.ndarray) -> bool:
    """Whether numbers [n, 3] are places in a local system: neither standing still, nor degrees of a flight, which are
    read (`--gps`)."""
    degrees, widths = np.abs(places[:, :2]), np.ptp(places, axis=0)
    is_earth = (degrees <= 180).all() and degrees.max() > NO_LAND_DEG and widths[:2].max() < _FLIGHT_DEG
    return bool((widths > 0).sum() > 1 and not is_earth)


def _may_be_place(heading: str) -> bool:
    plain = read_heading(heading).plain
    return plain[-1:] in ("x", "y", "z") and not _NO_PLACE.search(plain)


def _are_rotations(turns: np.ndarray) -> bool:
    """Whether matrices [n, 3, 3] are rotations."""
    if turns.shape[1:] != (3, 3) or not np.isfinite(turns).all() or np.abs(turns).max(initial=0) > 1 + _TOLERANCE:
        return False
    products = turns @ turns.transpose(0, 2, 1)
    return bool(np.abs(products - np.eye(3)).max() < _TOLERANCE and (np.linalg.det(turns) > 0).all())


def _is_turned(matrix: np.ndarray) -> bool:
    """Whether a matrix is another than the identity."""
    return bool(np.abs(matrix[:3, :3] - np.eye(3)).max() > _TOLERANCE)


def _numbers_of(text: str) -> list[float]:
    return [float(word) for word in text.strip("[] \n\r\t").split(",")]


def _is_array_of_poses(file: Path) -> bool:
    with file.open("rb") as stream:
        shape, kind = _header(stream)
    if kind not in "f" or len(shape) not in (2, 3) or math.prod(shape[1:]) not in range(7, 18) or shape[0] < _MIN_ROWS:
        return False
    rows = np.load(file, mmap_mode="r", allow_pickle=False)[:20]
    numbers = np.array(rows, dtype=np.float64).reshape(len(rows), -1)
    return bool(np.isfinite(numbers).all()) and (_matrices(numbers) or _quaternions(numbers, ()))


def _has_named_array(file: Path) -> bool:
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist()[:100]:
            if name.endswith(".npy") and _ARRAY.fullmatch(PurePath(name).stem):
                with archive.open(name) as stream:
                    shape, kind = _header(stream)
                if kind == "f" and shape[-2:] in ((3, 4), (4, 4)):
                    return True
    return False


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], str]:
    """The shape of an array in a stream, and the kind of its numbers, without reading it."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    return shape, dtype.kind
