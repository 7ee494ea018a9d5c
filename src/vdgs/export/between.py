"""Cameras between those of a capture: where people will look from, and where no photograph says what is to be seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import numpy as np
from jaxtyping import Float

from vdgs.cameras import Camera

#: A camera moves among so many of the nearest that look its way.
NEIGHBOURS = 3
#: That is: whose directions are at most about 45 degrees apart (cosine).
LIKE = 0.7
#: So many times colours are fitted again.
ROUNDS = 2


def rounds(training: Sequence[Camera]) -> tuple[Sequence[Camera], ...]:
    """By which pictures colours are fitted again, round by round: by those of the training cameras, and of others
    between them that no round has had before. Where only midway between neighbours is looked again and again, what
    suits those places is learnt by heart (docs/export.md)."""
    return tuple([*training, *between(training, number)] for number in range(ROUNDS))


def endless(training: Sequence[Camera]) -> Iterator[Camera]:
    """The training cameras and others between them, in random order, and so on: the others are never the same, nor any
    of `rounds`."""
    for number in count(ROUNDS):
        cameras = [*training, *between(training, number)]
        for i in np.random.default_rng(number).permutation(len(cameras)):
            yield cameras[i]


def between(cameras: Sequence[Camera], seed: int) -> list[Camera]:
    """Each camera that has neighbours somewhere between itself and these: in their mean by random weights, all equally
    likely, with its own orientation and picture."""
    places = np.array([camera.position for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    generator = np.random.default_rng(seed)
    found = []
    for i, camera in enumerate(cameras):
        weights = generator.dirichlet(np.ones(NEIGHBOURS + 1))
        if len(around := [i, *_alike(places, forward, i)]) > 1:
            own = weights[: len(around)] / weights[: len(around)].sum()
            found.append(_moved(camera, own @ places[around]))
    return found


def _alike(places: Float[np.ndarray, "n 3"], forward: Float[np.ndarray, "n 3"], i: int) -> list[int]:
    """The nearest others that look the way of a camera, nearest first."""
    apart = np.where(forward @ forward[i] > LIKE, np.linalg.norm(places - places[i], axis=1), np.inf)
    apart[i] = np.inf
    order = np.argsort(apart, kind="stable")[:NEIGHBOURS]
    return [int(j) for j in order if np.isfinite(apart[j])]


def _moved(camera: Camera, position: Float[np.ndarray, "3"]) -> Camera:
    matrix = camera.camera_from_world.copy()
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, camera_from_world=matrix)
