"""Cameras between those of a capture: where people will look from, and where no photograph says what is to be seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from vdgs.cameras import Camera

#: Each camera is paired with so many of the nearest that look its way, as long as there are fewer pairs than cameras.
NEIGHBOURS = 2
#: That is: whose directions are at most about 45 degrees apart (cosine).
LIKE = 0.7


def rounds(training: Sequence[Camera]) -> tuple[Sequence[Camera], ...]:
    """By which pictures colours are fitted again, round by round: by all, then by those of the training cameras alone,
    which gets as far as all twice would (docs/export.md)."""
    return [*training, *between(training)], training


def between(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras midway between neighbours, each with the orientation and the picture of one of them: all cameras with
    their nearest first, then with the next; as many as are given at most."""
    places = np.array([camera.position for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    nearest = [_alike(places, forward, i) for i in range(len(cameras))]
    pairs = dict[tuple[int, int], None]()  # in this order
    for rank in range(NEIGHBOURS):
        for i, others in enumerate(nearest):
            if rank < len(others):
                pairs[min(i, others[rank]), max(i, others[rank])] = None
    chosen = sorted(list(pairs)[: len(cameras)])
    return [_moved(cameras[i], (places[i] + places[j]) / 2) for i, j in chosen]


def _alike(places: Float[np.ndarray, "n 3"], forward: Float[np.ndarray, "n 3"], i: int) -> list[int]:
    """The nearest others that look the way of a camera, nearest first."""
    apart = np.where(forward @ forward[i] > LIKE, np.linalg.norm(places - places[i], axis=1), np.inf)
    apart[i] = np.inf
    order = np.argsort(apart, kind="stable")[:NEIGHBOURS]
    return [int(j) for j in order if np.isfinite(apart[j])]


def _moved(camera: Camera, position: np.ndarray) -> Camera:
    matrix = camera.camera_from_world.copy()
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, camera_from_world=matrix)
