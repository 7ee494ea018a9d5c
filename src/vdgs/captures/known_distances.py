"""Known distances between points that photographs show: a text file, and the scale that it gives a world.

Lines are `NAME px py photograph`, a mark in pixels, `NAME ray x y photograph`, a mark as x/z and y/z of the camera's
ray (which `vdgs view` writes: it holds for any size of the photograph), or `NAME NAME metres`, a distance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from vdgs.captures.formats.source_capture import SourceView
from vdgs.captures.name_resolution import NameLookup, find_one
from vdgs.captures.text_tables import read_lines
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center, camera_centers
from vdgs.geometry.ray_intersection import intersect_rays

#: Photographs that must show a point: one view tells a line, no place.
MIN_OBSERVATIONS = 2
#: What a mark is off by in pixels at least, and what a measured distance is good to as a share (choice).
LEAST_PX, LEAST_SHARE = 0.5, 0.002
#: What marks are off by along x and along y (pixels) before their own residuals tell it, and how many of these that
#: counts for: two views leave one residual of a point, which is small by chance in every second case (choice; with it
#: 95 % of true errors of 0.25 to 1 px are within what is said, and 81 % of those of 2 px in two views).
USUAL_PX, USUAL_COUNT = 1.1, 2
#: A distance that is told worse than the first (standard deviation, share) says nothing against others; a scale that is
#: told worse than the second is refused (choice).
POOR_SHARE, MOST_DOUBT = 0.02, 0.1
#: Distances that make scales differ by more than this share contradict each other (choice).
MOST_APART = 0.1
FORM = "`NAME px py photograph` or `NAME ray x y photograph` for a mark, or `NAME NAME metres` for a distance"
_RAY = "ray"


@dataclass(frozen=True)
class DistanceMark:
    """Where a photograph shows a point."""

    name: str
    photograph: str
    number: int
    """Of its line in the file."""
    at: tuple[float, float]
    """Pixels from the upper left corner, or x/z and y/z of the camera's ray."""
    is_ray: bool


@dataclass(frozen=True)
class KnownDistances:
    """Marks of points, and how far points are apart: two names, and metres."""

    marks: tuple[DistanceMark, ...]
    distances: tuple[tuple[str, str, float], ...]


def read_known_distances(file: Path) -> KnownDistances:
    """The marks and distances of a text file; `#` for comments. Raises CaptureError, naming the line, for a file that
    cannot be read, lines that are neither, and distances that are none."""
    marks: list[DistanceMark] = []
    distances: list[tuple[str, str, float]] = []
    for number, line in text_lines(file, "known distances"):
        words = line.split("\t") if "\t" in line else line.split()
        try:
            if len(words) == 3:
                distances.append((words[0], words[1], _meters(words[2])))
            else:
                marks.append(_mark(words, number))
        except (ValueError, IndexError):
            raise CaptureError(f"{file}: line {number}: {line[:80]!r} is not {FORM}. Mend the line.") from None
    if not distances:
        raise CaptureError(f"{file}: names no distance. Lines are {FORM}.")
    return KnownDistances(tuple(marks), tuple(distances))


def _mark(words: Sequence[str], number: int) -> DistanceMark:
    is_ray = words[1] == _RAY
    x, y, photograph = words[1 + is_ray : 4 + is_ray]
    if not (math.isfinite(float(x)) and math.isfinite(float(y))):
        raise ValueError(x)
    return DistanceMark(words[0], photograph.strip(), number, (float(x), float(y)), is_ray)


def _meters(word: str) -> float:
    value = float(word)
    if not (math.isfinite(value) and 0 < value < 1e6):
        raise ValueError(word)
    return value


def text_lines(file: Path, what: str) -> list[tuple[int, str]]:
    """The lines of a text file of `what` with their numbers, without empty ones and comments."""
    rows = [(line.number, line.text.strip()) for line in read_lines(file, f"list of {what}")]
    return [(number, line) for number, line in rows if not line.startswith("#")]


def check_marked(known: KnownDistances, images_of: Mapping[str, set[str]], file: Path) -> None:
    """Raise CaptureError for a point of a distance that fewer than two photographs show."""
    for name in dict.fromkeys(name for one, other, _ in known.distances for name in (one, other)):
        if len(images_of.get(name, set())) < MIN_OBSERVATIONS:
            raise CaptureError(f"{file}: the point {name} is marked in fewer than two photographs. Mark it in more.")


@dataclass(frozen=True, eq=False)
class LocatedPoint:
    """A point in a world, and how well its marks tell it."""

    position: Float[np.ndarray, "3"]
    error_px: float
    """RMS distance between its marks and where it is in the photographs."""
    num_marks: int
    spread: Float[np.ndarray, "3 3"]
    """Its covariance if marks are off by a pixel along x and along y, in units of the world squared. Along the line of
    sight it is many times that across, where views are near each other."""


def spread_of_marks(jacobians: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, "3 3"]:
    """The covariance of a point whose n marks are off by a pixel, by how pixels change with the point."""
    return np.asarray(np.linalg.pinv(np.einsum("nki,nkj->ij", jacobians, jacobians), hermitian=True))


def _length_deviation(one: LocatedPoint, other: LocatedPoint) -> float:
    """The standard deviation of the distance between two points, by the geometry of their rays and by their marks."""
    apart = other.position - one.position
    length = float(np.linalg.norm(apart))
    along, spread = apart / length, one.spread + other.spread
    free = sum(2 * point.num_marks - 3 for point in (one, other))
    squares = sum(point.num_marks * point.error_px**2 for point in (one, other))
    variance = (USUAL_COUNT * USUAL_PX**2 + squares) / (USUAL_COUNT + free)
    lengthwise = float(along @ spread @ along) * variance
    # What ends are off by across makes each distance longer, to second order.
    crosswise = float(np.trace(spread)) * variance - lengthwise
    return math.hypot(math.sqrt(lengthwise), crosswise / (2 * length))


def scale_of_distances(
    distances: Sequence[tuple[str, str, float]], located: Mapping[str, LocatedPoint], pixel: float, source: str
) -> tuple[float, float]:
    """The factor from a world to metres, and its standard deviation as a share; `pixel` is what one shows, in the
    world. Raises CaptureError for points that are not located, marks that are wrong, distances that contradict each
    other, and those that photographs do not tell."""
    factors, shares = np.array([_factor(*each, located, pixel, source) for each in distances]).T
    weights = 1 / np.square(shares)
    mean = float(np.exp((weights * np.log(factors)).sum() / weights.sum()))
    apart = np.abs(factors / mean - 1)
    against = float(np.max(apart, where=apart > 3 * shares, initial=0.0))
    if against > MOST_APART:
        raise CaptureError(
            f"{source}: its distances contradict each other by {against:.0%}. Look at marks and metres again."
        )
    doubt = max(float(1 / np.sqrt(weights.sum())), float(np.max(apart, where=shares <= POOR_SHARE, initial=0.0)) / 2)
    if doubt > MOST_DOUBT:
        raise CaptureError(
            f"{source}: the photographs tell its distances to ±{2 * doubt:.0%} only (95 %): they lie along the lines "
            "of sight of views that are near each other. Mark the points in photographs from other sides too, or "
            "measure a distance that lies across."
        )
    return mean, doubt


def _factor(
    one: str, other: str, meters: float, located: Mapping[str, LocatedPoint], pixel: float, source: str
) -> tuple[float, float]:
    """The factor from a world to metres by one distance, and its standard deviation as a share."""
    for name in (one, other):
        if name not in located:
            raise CaptureError(
                f"{source}: the point {name} is not shown by two placed photographs that agree on it. Mark it in more "
                "of them."
            )
    ends = located[one], located[other]
    length = float(np.linalg.norm(ends[0].position - ends[1].position))
    off = max(LEAST_PX, math.hypot(ends[0].error_px, ends[1].error_px)) * pixel
    if not length > 2 * off:
        raise CaptureError(
            f"{source}: {one} and {other} are {length / pixel:.0f} pixels apart and their marks are off by "
            f"{off / pixel:.0f}. Look at the marks again, or measure a longer distance."
        )
    off = max(LEAST_PX * pixel, _length_deviation(*ends))
    return meters / length, math.hypot(LEAST_SHARE, off / length)


def known_scale_of_views(
    file: Path, views: Sequence[SourceView], points: Float[np.ndarray, "n 3"]
) -> tuple[float, float]:
    """The factor from a capture's world to metres, and its standard deviation as a share.

    Pixels are those of the photographs at the size that the cameras are given for. Raises CaptureError as
    `read_known_distances` and `scale_of_distances`, and for photographs that are not there.
    """
    known = read_known_distances(file)
    lookup = NameLookup([(view.name, view) for view in views])
    seen: dict[str, list[tuple[SourceView, np.ndarray]]] = {}
    for mark in known.marks:
        view = find_one(lookup, mark.photograph, f"{file}: line {mark.number}", lambda view: view.name)
        seen.setdefault(mark.name, []).append((view, _ray(mark, view, file)))
    check_marked(known, {name: {view.name for view, _ in marks} for name, marks in seen.items()}, file)
    located = {name: place for name, marks in seen.items() if (place := _locate(marks)) is not None}
    centers = np.array([camera_center(view.camera_from_world) for view in views])
    middle = np.median(points, axis=0)
    focal = np.array([view.intrinsics.focal[0] for view in views])
    pixel = float(np.median(np.linalg.norm(centers - middle, axis=1) / focal))
    return scale_of_distances(known.distances, located, pixel, file.name)


def _ray(mark: DistanceMark, view: SourceView, file: Path) -> np.ndarray:
    """x/z, y/z and 1 in the camera."""
    lens = view.intrinsics
    if mark.is_ray:
        return np.array([*mark.at, 1.0])
    if lens.is_distorted:
        raise CaptureError(
            f"{file}: line {mark.number}: {view.name} has a lens with distortion, where a mark in pixels says too "
            "little. Undistort the capture, or measure in `vdgs view` (lines with `ray`)."
        )
    if not (0 <= mark.at[0] <= lens.width and 0 <= mark.at[1] <= lens.height):
        raise CaptureError(
            f"{file}: line {mark.number}: pixel {mark.at[0]:g}, {mark.at[1]:g} is outside {view.name}, whose camera is "
            f"given for {lens.width} x {lens.height}. Mark it in a photograph of that size."
        )
    return np.array([*((mark.at[k] - lens.principal_point[k]) / lens.focal[k] for k in (0, 1)), 1.0])


def _locate(marks: Sequence[tuple[SourceView, np.ndarray]]) -> LocatedPoint | None:
    """The point nearest to all rays; None where they are parallel, or it lies behind a camera."""
    poses = np.array([view.camera_from_world[:3] for view, _ in marks])
    rays = np.array([ray for _, ray in marks])
    centers = camera_centers(poses)
    place = intersect_rays(centers, np.einsum("nji,nj->ni", poses[:, :, :3], rays))
    if place is None:
        return None
    there = poses @ np.append(place, 1.0)
    if (there[:, 2] <= 0).any():
        return None
    focal = np.array([view.intrinsics.focal for view, _ in marks])
    off = (there[:, :2] / there[:, 2:] - rays[:, :2]) * focal
    return LocatedPoint(place, float(np.sqrt((off**2).sum(axis=1).mean())), len(marks), _spread(there, poses, focal))


def _spread(
    there: Float[np.ndarray, "n 3"], poses: Float[np.ndarray, "n 3 4"], focal: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3 3"]:
    """What marks of one pixel leave open of a point, which is `there` in the cameras."""
    x, y, z = there.T
    zero = np.zeros_like(z)
    projected = np.stack([np.stack([1 / z, zero, -x / z**2], 1), np.stack([zero, 1 / z, -y / z**2], 1)], axis=1)
    return spread_of_marks(focal[:, :, None] * projected @ poses[:, :, :3])
