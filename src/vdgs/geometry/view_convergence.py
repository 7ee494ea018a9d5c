"""The place on which the views of cameras converge, as those of a flight around a tower do; grids have none.

The place is nearest to all optical axes, by the least sum of the angles at which cameras see it beside their axes, so
that some cameras that look elsewhere do not move it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vdgs.geometry.camera import Camera

#: Views converge on a place where so many cameras at least, and such a share of all, see it within so many degrees of
#: their axis (choices: some of a flight are of the way there; along a bridge each looks at another part of it);
MIN_CAMERAS, MIN_SHARE, MAX_OFF_AXIS_DEG = 5, 2 / 3, 25.0
#: where axes turn with the cameras: the place is beside the axes by no more than this share of the angles by which
#: the directions to the cameras differ from their middle, which are so many degrees at least (medians). In a grid with
#: parallel or crossed axes both angles are alike, however small it is;
MAX_OFF_SHARE, MIN_SPREAD_DEG = 0.5, 10.0
#: and where the cameras stand around it: no wider angle, seen from above, is without any (half an orbit, and some).
MAX_GAP_DEG = 210.0
_ITERATIONS = 50


@dataclass(frozen=True, eq=False)
class Convergence:
    """What cameras look at; lengths in units of their world, z is up."""

    place: Float[np.ndarray, "3"]
    looking: Bool[np.ndarray, " n"]
    """Which of the cameras see it near their axis."""
    distance: float
    """Of those from it, median."""
    radius: float
    """Of the sphere about it that they look at: what half of the picture's shorter side spans at that distance, and how
    far the axes pass beside the place (90 % of them)."""


def find_convergence(cameras: Sequence[Camera]) -> Convergence | None:
    """The place on which the views of most cameras converge; None where they do not, or cameras do not stand around
    it: level or oblique grids, corridors, facades, pictures taken outwards from one place."""
    if len(cameras) < MIN_CAMERAS:
        return None
    positions = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.forward for camera in cameras])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    place = _nearest_to_axes(positions, axes)
    if place is None:
        return None
    toward = place - positions
    away = np.linalg.norm(toward, axis=1)
    if not (away > 1e-9 * (1 + np.abs(place).max())).all():
        return None
    toward /= away[:, None]
    off_deg = _angles_deg(toward, axes)
    looking = off_deg < MAX_OFF_AXIS_DEG
    if looking.sum() < max(MIN_CAMERAS, MIN_SHARE * len(cameras)):
        return None
    middle = toward[looking].mean(axis=0)
    spread_deg = float(np.median(_angles_deg(toward[looking], middle / max(float(np.linalg.norm(middle)), 1e-12))))
    if spread_deg < MIN_SPREAD_DEG or np.median(off_deg[looking]) > MAX_OFF_SHARE * spread_deg:
        return None
    if _widest_gap_deg(-toward[looking, :2]) > MAX_GAP_DEG:
        return None
    distance = float(np.median(away[looking]))
    half = np.median([min(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras])
    beside = np.quantile(away[looking] * np.sin(np.radians(off_deg[looking])), 0.9)
    return Convergence(place, looking, distance, float(distance * half + beside))


def _nearest_to_axes(positions: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "n 3"]) -> np.ndarray | None:
    """The point of the least sum of angles to axes, by least squares with weights; None where the axes fix none."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    weights = np.ones(len(axes))
    place: np.ndarray | None = None
    for _ in range(_ITERATIONS):
        normal = np.einsum("n,nij->ij", weights, across)
        if np.linalg.eigvalsh(normal)[0] < 1e-4 * weights.sum():  # parallel to within half a degree
            return None
        place = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weights, across, positions))
        offset = place - positions
        beside = np.linalg.norm(np.einsum("nij,nj->ni", across, offset), axis=1)
        away = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        # Weights of least squares for the sum of beside / away; below a degree all count alike.
        weights = 1 / (away**2 * np.maximum(beside / away, 0.02))
        weights /= weights.sum()
    return place


def _angles_deg(vectors: Float[np.ndarray, "n 3"], others: np.ndarray) -> Float[np.ndarray, " n"]:
    """Angles between unit vectors [n, 3] and others [n, 3] or [3]."""
    return np.degrees(np.arccos(np.clip((vectors * others).sum(axis=1), -1, 1)))


def _widest_gap_deg(bearings: Float[np.ndarray, "n 2"]) -> float:
    """The widest angle without any of the directions [n, 2]."""
    angles = np.sort(np.degrees(np.arctan2(bearings[:, 1], bearings[:, 0])))
    return float(np.diff(angles, append=angles[:1] + 360).max())
