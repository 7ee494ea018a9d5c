"""VisualSFM's .nvm, as others write it too: cameras, points, and which photograph shows which point, in text.

A camera has its center and the rotation from the world to its axes right, down, forward; in NVM_V3_R9T a matrix and a
translation. Pixels count from the middle of the image, y down. Of a pixel at m, in focal lengths, the ray is
m (1 + r m²): the lens is told from the picture to the ray. The size of the photographs is not in the file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vdgs.captures.formats.brown_lens import brown_intrinsics
from vdgs.captures.formats.colmap import rotation_from_quaternion
from vdgs.captures.formats.photograph_sizes import GIVE_ALIGNED, check_seen_inside, photograph_sizes
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_centered, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import files_ending
from vdgs.captures.text_tables import read_head, read_text
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

_HEADER, _MATRIX = "NVM_V3", "NVM_V3_R9T"
_POINT_NUMBERS, _SIGHTING_NUMBERS = 7, 4
#: The lens from the ray to the picture may miss the file's by so much within the photograph, in pixels.
_MISS_PX = 0.05
_AGAIN = "The file is damaged or cut off; export it again."


def is_file(file: Path) -> bool:
    return file.suffix.lower() == ".nvm" and read_head(file, 4 * len(_HEADER)).startswith(_HEADER)


def find_files(root: Path) -> list[Path]:
    return [*filter(is_file, files_ending(root, ".nvm"))]


def read(file: Path, options: CaptureOptions) -> Project:
    """The first model of a file, which is the biggest. Raises `CaptureError` for damaged files."""
    lines = [line.strip() for line in read_text(file).splitlines()]
    header, lines = lines[0].split() if lines else [], [line for line in lines[1:] if line and line[0] != "#"]
    count = _count(lines, 0, file)
    cameras = [_camera(line, header[0] == _MATRIX, file) for line in lines[1 : count + 1]]
    points, colors, shown = _points(lines[count + 2 :], _count(lines, count + 1, file), file)
    shared = _numbers(header[2:], file) if header[1:2] == ["FixedK"] else []
    if len(shared) not in (0, 4, 5):
        raise CaptureError(f"{file}: FixedK must be followed by fx, cx, fy, cy and the distortion. {_AGAIN}")
    names = [name for name, *_ in cameras]
    views, refused = list[ProjectView](), dict[str, list[str]]()
    sizes = photograph_sizes(file.parent, options, names, file)
    for index, (size, (name, focal, radial, pose)) in enumerate(zip(sizes, cameras, strict=True)):
        center, lens = _calibration(focal, radial, shared, size, file, name)
        if isinstance(lens, str):
            refused.setdefault(lens, []).append(name)
            continue
        numbers, pixels = shown.get(index, ([], []))
        seen = np.array(pixels).reshape(-1, 2) + center
        if not shared:  # who writes FixedK may count these from the corner too
            check_seen_inside(seen, size, file, name)
        views.append(
            ProjectView(
                names=(name,), camera_from_world=pose, intrinsics=lens, sightings=(np.array(numbers, np.int64), seen)
            )
        )
    more = [line for line in lines[count + 2 + len(points) :] if line != "0"]
    note = (f"{file.name}: only its first model is read, that of {count} photographs.",) if more[:1] else ()
    return Project(
        format="visualsfm", file=file, views=tuple(views), points=points, colors=colors, warnings=note,
        refused=refused, remedy="Undistort the photographs, and reconstruct from those",
    )  # fmt: skip


def _calibration(
    focal: float, radial: float, shared: list[float], size: tuple[int, int], file: Path, name: str
) -> tuple[tuple[float, float], Intrinsics | str]:
    """The principal point of a camera, and its lens or why there is none; `shared` is what FixedK says of all."""
    if not shared:
        center = (size[0] / 2, size[1] / 2)
        return center, _lens((focal, focal), center, size, radial, file, name)
    # Some writers count the principal point from the corner.
    middle = [0.0 if abs(c) > 0.25 * side else side / 2 for c, side in zip(shared[1::2], size, strict=True)]
    center = (shared[1] + middle[0], shared[3] + middle[1])
    check_centered(center, size, file, name, GIVE_ALIGNED)
    return center, _lens((shared[0], shared[2]), center, size, (*shared, 0.0)[4], file, name)


def _count(lines: list[str], at: int, file: Path) -> int:
    """A number of cameras or points, each of which has a line after it."""
    if at >= len(lines) or not lines[at].isdecimal() or int(lines[at]) > len(lines) - at - 1:
        raise CaptureError(f"{file}: ends before the cameras and points that it announces. {_AGAIN}")
    return int(lines[at])


def _numbers(words: list[str], file: Path) -> list[float]:
    try:
        found = np.array(words, np.float64)
    except ValueError as error:
        raise CaptureError(f"{file}: holds what is no number ({error}). {_AGAIN}") from None
    if not np.isfinite(found).all():
        raise CaptureError(f"{file}: holds a number that is not finite. {_AGAIN}")
    return found.tolist()


def _camera(line: str, is_matrix: bool, file: Path) -> tuple[str, float, float, np.ndarray]:
    """The name, focal length, distortion and pose of a camera."""
    words, count = line.split(), 15 if is_matrix else 10
    if len(words) < count + 1:
        raise CaptureError(f"{file}: the camera {line[:60]!r} has fewer than {count} numbers. {_AGAIN}")
    name = " ".join(words[:-count]).replace('"', " ")  # which stand for blanks
    focal, *rest = _numbers(words[-count:], file)
    turn = np.reshape(rest[:9], (3, 3)) if is_matrix else np.array(rest[:4])
    if not is_matrix:
        turn = rotation_from_quaternion(turn / (np.linalg.norm(turn) or 1.0))
    pose = to_rigid(np.column_stack([turn, np.zeros(3)]), file, name)
    pose[:3, 3] = rest[-5:-2] if is_matrix else -pose[:3, :3] @ rest[-5:-2]
    return name, focal, rest[-2], pose


def _lens(
    focal: tuple[float, float], center: tuple[float, float], size: tuple[int, int], radial: float, file: Path, name: str
) -> Intrinsics | str:
    """The lens from the ray to the picture that is, within the photograph, the inverse of the file's; why there is
    none."""
    plain = check_intrinsics(Intrinsics("PINHOLE", (*focal, *center), *size), file, name)
    if not radial:
        return plain
    farthest = np.hypot(*(np.maximum(np.array(center), np.array(size) - center) / focal))
    bent = np.linspace(0, farthest, 200)[1:]
    straight = bent * (1 + radial * bent**2)
    powers = straight[:, None] ** np.arange(2, 9, 2)
    if 1 + 3 * radial * farthest**2 > 0:
        terms = np.linalg.lstsq(powers * straight[:, None], bent - straight, rcond=None)[0]
        if np.abs(straight * (1 + powers @ terms) - bent).max() * max(focal) < _MISS_PX:
            return check_intrinsics(brown_intrinsics(focal, center, size, terms.tolist()), file, name)
    return "the lens bends too much, or folds over, within the photograph"


def _points(
    lines: list[str], count: int, file: Path
) -> tuple[np.ndarray, np.ndarray, dict[int, tuple[list[int], list[list[float]]]]]:
    """Points, colors, and by the index of the camera the points that it shows."""
    points, colors = np.zeros((count, 3)), np.zeros((count, 3), np.uint8)
    shown: dict[int, tuple[list[int], list[list[float]]]] = {}
    for index, line in enumerate(lines[:count]):
        numbers = _numbers(line.split(), file)
        sights = numbers[_POINT_NUMBERS:]
        if len(numbers) < _POINT_NUMBERS or len(sights) < _SIGHTING_NUMBERS * numbers[6]:
            raise CaptureError(f"{file}: ends within point {index} of {count}. {_AGAIN}")
        points[index], colors[index] = numbers[:3], np.clip(numbers[3:6], 0, 255)
        for first in range(0, _SIGHTING_NUMBERS * int(numbers[6]), _SIGHTING_NUMBERS):
            listed, pixels = shown.setdefault(int(sights[first]), ([], []))
            listed.append(index)
            pixels.append(sights[first + 2 : first + 4])
    return points, colors, shown
