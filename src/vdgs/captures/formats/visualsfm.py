"""VisualSFM's .nvm, as others write it too: cameras, points, and which photograph shows which point, in text.

A camera has its center and the rotation from the world to its axes right, down, forward; in NVM_V3_R9T a matrix and a
translation. Pixels count from the middle of the image, y down. Of a pixel at m, in focal lengths, the ray is
m (1 + r m²): the lens is told from the picture to the ray. The size of the photographs is not in the file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vdgs.captures.formats.aligned_sizes import aligned_sizes
from vdgs.captures.formats.brown_lens import brown_intrinsics
from vdgs.captures.formats.center_sizes import told_size
from vdgs.captures.formats.colmap import rotation_from_quaternion
from vdgs.captures.formats.photograph_sizes import GIVE_ALIGNED
from vdgs.captures.formats.project import Project, ProjectView
from vdgs.captures.formats.source_capture import Intrinsics, check_intrinsics, to_rigid
from vdgs.captures.formats.xml_documents import files_ending
from vdgs.captures.text_tables import parse_numbers, read_head, read_text
from vdgs.config.capture_options import CaptureOptions
from vdgs.errors import CaptureError

_HEADER, _MATRIX = "NVM_V3", "NVM_V3_R9T"
_POINT_NUMBERS, _SIGHTING_NUMBERS = 7, 4
#: The lens from the ray to the picture may miss the file's by so much within the photograph, in pixels.
_MISS_PX = 0.05
#: From the middle a principal point is no farther than this share of what the farthest points are (choice).
_NEAR_MIDDLE = 0.2
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
    num_points = _count(lines, count + 1, file)
    points, colors, shown = _points(lines[count + 2 :], num_points, file)
    shared = _numbers(header[2:], file) if header[1:2] == ["FixedK"] else []
    if len(shared) not in (0, 4, 5):
        raise CaptureError(f"{file}: FixedK must be followed by fx, cx, fy, cy and the distortion. {_AGAIN}")
    names = [name for name, *_ in cameras]
    views, refused = list[ProjectView](), dict[str, list[str]]()
    seen = [np.array(shown.get(index, ([], []))[1]).reshape(-1, 2) for index in range(count)]
    from_corner, seen_from_corner = _counts_from_corner(shared, seen)
    told = shared[1:4:2] if shared else (0.0, 0.0)
    from_middle = [each[:0] if from_corner or seen_from_corner else each + told for each in seen]
    sizes, notes = aligned_sizes(file.parent, options, names, from_middle, file)
    for index, (size, (name, focal, radial, pose)) in enumerate(zip(sizes, cameras, strict=True)):
        center, lens = _calibration(focal, radial, shared, from_corner, size, file, name)
        if isinstance(lens, str):
            refused.setdefault(lens, []).append(name)
            continue
        pixels = seen[index] if seen_from_corner else seen[index] + center
        sightings = np.array(shown.get(index, ([], []))[0], np.int64), pixels
        views.append(ProjectView(names=(name,), camera_from_world=pose, intrinsics=lens, sightings=sightings))
    if len(points) < num_points:
        notes.append(
            f"{file.name}: {num_points - len(points)} of its {num_points} points have coordinates that are not finite, "
            "and are left out."
        )
    if any(line != "0" for line in lines[count + 2 + num_points :]):
        notes.append(f"{file.name}: only its first model is read, that of {count} photographs.")
    return Project(
        format="visualsfm", file=file, views=tuple(views), points=points, colors=colors, warnings=tuple(notes),
        refused=refused, remedy="Undistort the photographs, and reconstruct from those",
    )  # fmt: skip


def _calibration(
    focal: float, radial: float, shared: list[float], from_corner: bool, size: tuple[int, int], file: Path, name: str
) -> tuple[tuple[float, float], Intrinsics | str]:
    """The principal point of a camera, and its lens or why there is none; `shared` is what FixedK says of all, its
    principal point `from_corner` or from the middle."""
    if not shared:
        center = (size[0] / 2, size[1] / 2)
        return center, _lens((focal, focal), center, size, radial, file, name)
    center = (shared[1], shared[3])
    if from_corner:
        size = told_size(size, center, file, name, GIVE_ALIGNED)
    else:
        center = (center[0] + size[0] / 2, center[1] + size[1] / 2)
    return center, _lens((shared[0], shared[2]), center, size, (*shared, 0.0)[4], file, name)


def _counts_from_corner(shared: list[float], seen: list[np.ndarray]) -> tuple[bool, bool]:
    """Whether FixedK counts the principal point from the corner, and whether the file counts the pixels of points from
    there, as some writers do."""
    if not shared:
        return False, False
    pixels = np.concatenate([np.zeros((0, 2)), *seen])
    reach = float(np.abs(pixels).max()) if len(pixels) else shared[0]
    return max(abs(shared[1]), abs(shared[3])) > _NEAR_MIDDLE * reach, len(pixels) > 0 and bool((pixels >= 0).all())


def _count(lines: list[str], at: int, file: Path) -> int:
    """A number of cameras or points, each of which has a line after it."""
    if at >= len(lines) or not lines[at].isdecimal() or int(lines[at]) > len(lines) - at - 1:
        raise CaptureError(f"{file}: ends before the cameras and points that it announces. {_AGAIN}")
    return int(lines[at])


def _numbers(words: list[str], file: Path) -> list[float]:
    found = _numbers_or_nan(words, file)
    if not np.isfinite(found).all():
        raise CaptureError(f"{file}: holds a number that is not finite. {_AGAIN}")
    return found


def _numbers_or_nan(words: list[str], file: Path) -> list[float]:
    try:
        return parse_numbers(words).tolist()
    except ValueError as error:
        raise CaptureError(f"{file}: holds what is no number ({error}). {_AGAIN}") from None


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
    """Points, colors, and by the index of the camera the points that it shows; without points that are not finite."""
    points, colors = list[list[float]](), list[list[float]]()
    shown: dict[int, tuple[list[int], list[list[float]]]] = {}
    for number, line in enumerate(lines[:count]):
        numbers = _numbers_or_nan(line.split(), file)
        sights = numbers[_POINT_NUMBERS:]
        if len(numbers) < _POINT_NUMBERS or not 0 <= _SIGHTING_NUMBERS * numbers[6] <= len(sights):
            raise CaptureError(f"{file}: ends within point {number} of {count}. {_AGAIN}")
        if not np.isfinite(numbers).all():
            continue
        for first in range(0, _SIGHTING_NUMBERS * int(numbers[6]), _SIGHTING_NUMBERS):
            listed, pixels = shown.setdefault(int(sights[first]), ([], []))
            listed.append(len(points))
            pixels.append(sights[first + 2 : first + 4])
        points.append(numbers[:3])
        colors.append(numbers[3:6])
    clipped = np.reshape(colors, (-1, 3)).clip(0, 255).astype(np.uint8)
    return np.reshape(points, (-1, 3)), clipped, shown
