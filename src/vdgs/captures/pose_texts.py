"""Texts of numbers that are poses of other programs, told from logs, points and matrices by what the numbers are.

Each test takes the path of a file and the whole lines at its beginning.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import PurePosixPath

import numpy as np

from vdgs.captures.column_headings import read_heading
from vdgs.captures.table_columns import known_columns, number_of

#: Rotations and quaternions are exact to so much, as few decimals leave them.
_TOLERANCE = 1e-3
#: One or two rows that fit may be chance: so many are needed of a trajectory.
_MIN_ROWS = 3
#: The heading of a table is in one of the first lines, and its first row not far below.
_HEADING_LINES, _ROW_LINES = 4, 3
_KITTI_360_NAMES = {"cam0_to_world.txt", "poses.txt"}
_DTU = re.compile(r"(^|/)cal[^/]*/pos_\d+\.txt$", re.IGNORECASE)
#: Columns of positions beside those that tables of positions have.
_PLACES = (*((f"{start}x", f"{start}y") for start in ("t", "p", "pos", "position")), ("x0", "y0"), ("xc", "yc"))
#: No table of poses has more columns (choice).
_MOST_COLUMNS = 100
#: A moment, a position, a quaternion, speeds and biases (choice).
_MOST_TRAJECTORY_COLUMNS = 20


def is_kitti(path: str, text: str) -> bool:
    """Rows of a matrix of 3 x 4, world from camera."""
    rows = _rows(text, 12)
    return len(rows) > 1 and all(_is_rotation(row.reshape(3, 4)[:, :3]) for row in rows)


def is_kitti_360(path: str, text: str) -> bool:
    """Rows of a frame's number and a matrix of 3 x 4 or 4 x 4, in files of KITTI-360's names."""
    if PurePosixPath(path).name.lower() not in _KITTI_360_NAMES:
        return False
    rows = [*_rows(text, 13), *_rows(text, 17)]
    return len(rows) > 1 and all(row[0] % 1 == 0 and _is_rotation(row[1:13].reshape(3, 4)[:, :3]) for row in rows)


def is_tum(path: str, text: str) -> bool:
    """Rows of a moment, a position and a quaternion."""
    return _is_trajectory(np.array(_rows(text, 8)).reshape(-1, 8))


def is_trajectory(path: str, text: str) -> bool:
    """The same with commas, and perhaps speeds behind (VINS)."""
    lines = [line.strip(" ,;\r").split(",") for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows = np.array([[number_of(word) for word in line] for line in lines if len(line) == len(lines[0])], float)
    is_whole = len(rows) == len(lines) > 0 and 8 <= rows.shape[1] <= _MOST_TRAJECTORY_COLUMNS
    return is_whole and bool(np.isfinite(rows).all()) and _is_trajectory(rows)


def _is_trajectory(rows: np.ndarray) -> bool:
    """Whether rows [n, 8 or more] are of one moment after the other, and have a quaternion behind a position."""
    return len(rows) >= _MIN_ROWS and bool((np.diff(rows[:, 0]) > 0).all()) and are_quaternions(rows[:, 4:8])


def are_quaternions(turns: np.ndarray) -> bool:
    """Whether rows [n, 4] of numbers are quaternions. Logs of receivers end in three small deviations and the quality
    of the solution, 1: of a quaternion with 1 the others are 0."""
    if not np.isfinite(turns).all():
        return False
    is_quality = (np.abs(turns).max(axis=1) == 1) & (np.count_nonzero(turns, axis=1) > 1)
    return bool((np.abs(np.linalg.norm(turns, axis=1) - 1) < _TOLERANCE).all() and not is_quality.all())


def has_local_places(headings: Sequence[str]) -> bool:
    """Whether headings are those of positions in the own system of a program (tx, pos_x)."""
    plain = {read_heading(word).plain for word in headings}
    return any({*pair} <= plain for pair in _PLACES)


def is_matrices(path: str, text: str) -> bool:
    """Rows of a matrix of 4 x 4, world from camera; one alone may be of one photograph."""
    rows = np.array(_rows(text, 16)).reshape(-1, 4, 4)
    return len(rows) > 1 and bool((rows[:, 3] == [0, 0, 0, 1]).all()) and all(_is_rotation(row[:3, :3]) for row in rows)


def is_dtu(path: str, text: str) -> bool:
    """A matrix of 3 x 4 where DTU has them: in a folder of calibrations, in a file of a position."""
    return bool(_DTU.search(path)) and len(_rows(text, 4)) == 3


def is_bundler(path: str, text: str) -> bool:
    """Numbers of cameras and points, then of each camera its focal length with two terms of the lens, a rotation and a
    translation; all 0 for photographs that were not placed."""
    first, _, rest = text.lstrip().partition("\n")
    if not re.fullmatch(r"\d+ \d+", first.strip()):
        return False
    lines = rest.splitlines()
    for start in range(0, len(lines) - 4, 5):
        rows = np.array(_rows("\n".join(lines[start : start + 5]), 3))
        if len(rows) != 5 or rows.any():
            return len(rows) == 5 and rows[0, 0] > 0 and _is_rotation(rows[1:4])
    return False


def is_angle_table(path: str, text: str) -> bool:
    """A table of positions with omega, phi and kappa."""
    return _is_table(text, lambda word: next((each for each in ("omega", "phi", "kappa") if word.startswith(each)), ""))


def is_quaternion_table(path: str, text: str) -> bool:
    """A table of positions with quaternions."""
    return _is_table(text, lambda word: word if word in {"qw", "qx", "qy", "qz"} else "")


def _is_table(text: str, turn_of: Callable[[str], str]) -> bool:
    """Whether one of the first lines is a heading with columns of a plane and all those of a rotation, of no system
    that is named above it, and one of the next a row of numbers in them."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    for k, line in enumerate(lines[:_HEADING_LINES]):
        for separator in ("\t", ";", ",", None):
            words = [word.strip(' "') for word in line.lstrip("#$/ ").split(separator)]
            columns = _pose_columns(words, turn_of) if 5 < len(words) < _MOST_COLUMNS else []
            if columns:
                is_named = any(re.search(r"\bepsg\b|\butm\b", above, re.IGNORECASE) for above in lines[:k])
                below = [each.split(separator) for each in lines[k + 1 : k + 1 + _ROW_LINES]]
                return not is_named and any(_is_row(row, len(words), columns, separator) for row in below)
    return False


def _pose_columns(words: list[str], turn_of: Callable[[str], str]) -> list[int]:
    """The columns of positions and rotations; none where one is missing."""
    plain = [read_heading(word).plain for word in words]
    turns = {turn: k for k, word in enumerate(plain) if (turn := turn_of(word))}
    known = known_columns(words)
    places = [[known[each] for each in ("x", "y")]] if {"x", "y"} <= {*known} else []
    places += [[plain.index(word) for word in pair] for pair in _PLACES if {*pair} <= {*plain}]
    is_whole = {*turns} in ({"omega", "phi", "kappa"}, {"qw", "qx", "qy", "qz"})
    return [*places[0], *turns.values()] if places and is_whole else []


def _is_row(words: list[str], count: int, columns: list[int], separator: str | None) -> bool:
    """Whether a line has as many words as its heading, and numbers in these columns."""
    if len(words) != count:
        return False
    decimal = [words[k].replace(",", ".") if separator == ";" else words[k] for k in columns]
    return all(math.isfinite(number_of(word.strip(' "'))) for word in decimal)


def _rows(text: str, count: int) -> list[np.ndarray]:
    """The lines of a text as numbers; none where one is of others than so many."""
    rows = [[number_of(word) for word in line.split()] for line in text.splitlines() if line.strip()]
    if any(len(row) != count or not np.isfinite(row).all() for row in rows):
        return []
    return [np.array(row) for row in rows]


def _is_rotation(matrix: np.ndarray) -> bool:
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < _TOLERANCE and np.linalg.det(matrix) > 0)
