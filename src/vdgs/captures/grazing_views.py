"""What of the ground the photographs show at grazing angles alone, from where a map of it is rough."""

from __future__ import annotations

import numpy as np

from vdgs.captures.capture import Capture
from vdgs.captures.scene_points import scene_points

#: A view is grazing so many degrees from straight down: a pixel shows twice as much of the ground there. From this
#: share of the ground on that is told (choices).
GRAZING_DEG, TOLD_SHARE = 60.0, 0.2
#: The ground is asked at one point of each cell of a level grid of so many cells along its longer side.
_CELLS, _MAX_POINTS = 64, 20_000


def grazing_share(capture: Capture) -> float:
    """The share of the ground, by a sparse point in each cell, that no training camera sees from nearer to straight
    above than `GRAZING_DEG`; 0 without points."""
    points = scene_points(capture, _MAX_POINTS)
    if not len(points):
        return 0.0
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    cells = np.floor((points[:, :2] - low) / max(float((high - low).max()) / _CELLS, 1e-12)).astype(int)
    points = points[np.unique(cells, axis=0, return_index=True)[1]]
    steep = np.zeros(len(points), bool)
    for camera in (view.camera for view in capture.train_views):
        left = np.flatnonzero(~steep)
        toward = camera.position - points[left]
        above = toward[:, 2] > np.cos(np.radians(GRAZING_DEG)) * np.linalg.norm(toward, axis=1)
        steep[left[above]] = camera.in_frustum(points[left[above]])
    return float((~steep).mean())


def grazing_note(share: float) -> str:
    """What to say where such a share of the ground is seen at grazing angles alone; empty where it is small."""
    if share < TOLD_SHARE:
        return ""
    return (
        f"{share:.0%} of the ground is seen only more than {GRAZING_DEG:.0f}° from straight down: colors and heights "
        "of the maps are rough there. Photographs that look down make them better"
    )
