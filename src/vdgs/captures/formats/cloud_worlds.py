"""In which coordinates a point cloud beside cameras is: those in which its points fall into their photographs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vdgs.captures.formats.source_capture import Intrinsics
from vdgs.errors import CaptureError
from vdgs.geometry.camera import camera_center
from vdgs.geometry.similarity import sample_points

#: A cloud belongs to the cameras if this share of its points fall into photographs (choice).
LEAST_SEEN, POINTS_LOOKED_AT = 0.3, 2000
#: Points farther from a camera than this many times the spread of the cameras are not of their place.
MAX_DISTANCE_RATIO = 100.0
#: Photographs are looked at in so many parts a side, and so many of them, with more points: a few may cover them.
PARTS, VIEWS_LOOKED_AT, POINTS_IN_PARTS = 4, 40, 50_000
#: A cloud is in other coordinates than it should be where it covers so many times more of the photographs there
#: (choice), and of another place where it covers less of them than this, and `LEAST_SEEN` is not met.
BETTER, LEAST_COVERED = 2.0, 0.1
#: Of coordinates that are tried in order, later ones are taken where they fit so many times better (choice).
LATER_BETTER = 1.05
#: Points whose spread across their longest line is less than this share of their distance are at one spot (choice).
ONE_SPOT, FEWEST_IN_SPOT = 0.01, 10
#: Fewer points cover too little to tell by that alone: they stay where photographs see them (choice).
ENOUGH_POINTS = 50

#: The name of some coordinates, and what brings points [n, 3] from there.
CloudFrame = tuple[str, Callable[[np.ndarray], np.ndarray]]


class Eye(NamedTuple):
    """A camera: its pose [4, 4] (camera from world), and its lens, of which distortion is left aside."""

    camera_from_world: np.ndarray
    lens: Intrinsics


def share_seen(points: np.ndarray, eyes: Sequence[Eye], farthest: float | None = None) -> float:
    """The share of points [n, 3] that lie before some camera, where its photograph is, and no farther away than
    `farthest` (by default by `MAX_DISTANCE_RATIO`)."""
    points = points[np.isfinite(points).all(axis=1)]
    farthest = _farthest(eyes) if farthest is None else farthest
    seen = np.zeros(len(points), bool)
    for eye in eyes:
        seen |= _shares_of_sides(points, eye, farthest)[0]
    return float(seen.mean()) if len(seen) else 0.0


def share_covered(points: np.ndarray, eyes: Sequence[Eye], farthest: float | None = None) -> float:
    """The share of the parts of some photographs that show a point, as `share_seen` has it."""
    points = points[np.isfinite(points).all(axis=1)]
    farthest, covered = _farthest(eyes) if farthest is None else farthest, list[float]()
    for eye in eyes[:: max(1, len(eyes) // VIEWS_LOOKED_AT)]:
        seen, across, down = _shares_of_sides(points, eye, farthest)
        parts = np.floor(PARTS * np.column_stack([across[seen], down[seen]])).clip(0, PARTS - 1)
        covered.append(len(np.unique(parts @ [1, PARTS])) / PARTS**2)
    return float(np.mean(covered)) if covered else 0.0


def in_world_of(
    points: np.ndarray, cloud: Path, eyes: Sequence[Eye], others: Sequence[CloudFrame], notes: list[str], remedy: str
) -> np.ndarray:
    """Points [n, 3] of a cloud in the world of cameras: as they are, unless they cover far more of the photographs once
    brought there from one of `others`, which a note says.

    As they are, they may be at any distance: cameras that hardly moved look at what is far for their spread.

    Raises `CaptureError`, with the `remedy`, for a cloud that hardly any photograph shows.
    """
    if not len(points) or not eyes:
        return points
    looked_at = sample_points(points, POINTS_IN_PARTS)
    with np.errstate(all="ignore"):
        usual = share_covered(looked_at, eyes, math.inf)
        seen = share_seen(sample_points(points, POINTS_LOOKED_AT), eyes, math.inf)
        found = [(share_covered(change(looked_at), eyes), name, change) for name, change in others]
        best, name, change = max(found, key=lambda each: each[0], default=(0.0, "", lambda points: points))
        can_tell = len(looked_at) >= ENOUGH_POINTS or seen < LEAST_SEEN
        if can_tell and best > BETTER * usual and best >= LEAST_COVERED:
            notes.append(
                f"{cloud.name}: its points are {name}, where the photographs show them; they are brought over."
            )
            return change(points)
    if usual < LEAST_COVERED and seen < LEAST_SEEN:
        raise CaptureError(
            f"{cloud}: its points are not where the cameras look ({seen:.0%} fall into photographs): it is in other "
            "coordinates, or of another place, or the poses are of another convention (OpenCV's axes in place of "
            f"OpenGL's axes, camera-from-world in place of world-from-camera). {remedy}"
        )
    return points


def best_frame(points: np.ndarray, eyes: Sequence[Eye], frames: Sequence[CloudFrame]) -> tuple[CloudFrame, float]:
    """The one of some frames (the likeliest first, at least one) that points [n, 3] are in, and the share of the points
    that photographs show there; 0 where they are in none.

    A cloud that a wrong frame shrinks falls into photographs as a whole, and one that it blows up fills photographs as
    a whole: only in the right one does it do both. A frame that refuses the points (`CaptureError`) is not theirs.
    """
    looked_at = sample_points(points, POINTS_IN_PARTS)
    best, best_seen, best_fit = frames[0], 0.0, 0.0
    for frame in frames:
        try:
            with np.errstate(all="ignore"):
                moved = frame[1](looked_at)
                seen = 0.0 if _is_one_spot(moved, eyes) else share_seen(sample_points(moved, POINTS_LOOKED_AT), eyes)
                fit = seen * share_covered(moved, eyes) if seen else 0.0
        except CaptureError:
            continue
        if fit > LATER_BETTER * best_fit:
            best, best_seen, best_fit = frame, seen, fit
    return best, best_seen


def _is_one_spot(points: np.ndarray, eyes: Sequence[Eye]) -> bool:
    """Whether cameras have points [n, 3] at one spot, or on one line, as degrees are that are taken for metres."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < FEWEST_IN_SPOT:
        return False
    middle = np.median(points, axis=0)
    centers = np.stack([camera_center(eye.camera_from_world) for eye in eyes])
    away = np.linalg.norm(points - middle, axis=1)
    near = points[away <= 3 * np.median(away)] - middle
    spread = np.sqrt(np.linalg.eigvalsh(near.T @ near / len(near)).clip(min=0))  # ascending
    return bool(spread[1] < ONE_SPOT * np.linalg.norm(centers - middle, axis=1).min())


def _farthest(eyes: Sequence[Eye]) -> float:
    centers = np.stack([camera_center(eye.camera_from_world) for eye in eyes])
    spread = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return MAX_DISTANCE_RATIO * float(np.quantile(spread, 0.9))


def _shares_of_sides(points: np.ndarray, eye: Eye, farthest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which points [n] a photograph shows, bool, and where: shares of its width and of its height."""
    pose, lens = eye
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    (fx, fy), (cx, cy) = lens.focal, lens.principal_point
    with np.errstate(all="ignore"):
        across, down = (fx * x / z + cx) / lens.width, (fy * y / z + cy) / lens.height
    seen = (z > 0) & (z <= farthest) & (across >= 0) & (down >= 0) & (across <= 1) & (down <= 1)
    return seen, across, down
