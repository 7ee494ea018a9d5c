"""Cameras between those of a capture: where people will look from, and where no photograph says what is to be seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vdgs.cameras import Camera

#: Each camera is paired with so many of the nearest that look its way.
NEIGHBOURS = 2
#: That is: whose directions are at most about 45 degrees apart (cosine).
LIKE = 0.7


def rounds(training: Sequence[Camera]) -> tuple[Sequence[Camera], ...]:
    """By which pictures colours are fitted again, round by round: by all, then by those of the training cameras alone,
    which gets as far as all twice would (docs/export.md)."""
    return [*training, *between(training)], training


def between(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras midway between neighbours, each with the orientation and the picture of one of them; fewer than
    `NEIGHBOURS` times as many as those that are given."""
    places = np.array([camera.position for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    pairs = set[tuple[int, int]]()
    for i in range(len(cameras)):
        apart = np.where(forward @ forward[i] > LIKE, np.linalg.norm(places - places[i], axis=1), np.inf)
        apart[i] = np.inf
        nearest = np.argsort(apart, kind="stable")[:NEIGHBOURS]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest if np.isfinite(apart[j])}
    return [_moved(cameras[i], (places[i] + places[j]) / 2) for i, j in sorted(pairs)]


def _moved(camera: Camera, position: np.ndarray) -> Camera:
    matrix = camera.camera_from_world.copy()
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, camera_from_world=matrix)
