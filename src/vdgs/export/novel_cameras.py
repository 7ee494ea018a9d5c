"""Cameras between those of a capture: where people will look from, and where no photograph says what is to be seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vdgs.geometry.camera import Camera

#: A camera moves among so many of the nearest that look its way.
NEIGHBOURS = 3
#: That is: whose directions are at most about 45 degrees apart (cosine).
LIKE = 0.7
#: They are turned about each axis by up to this share of half of what a picture's width holds, so as to look at what no
#: photograph nearby shows too: seen from afar alone, it would take any colour (docs/export.md).
TURNED = 0.5
#: So many times colours are fitted again, and how often where anchors spawn more Gaussians than that.
ROUNDS, ROUNDS_OF_MANY, MANY_GAUSSIANS = 8, 1, 4_000_000
#: No seed of `rounds` reaches here.
BEYOND_ROUNDS = 1000


def round_count(asked: int | None, gaussians: int) -> int:
    """How many rounds, for so many Gaussians that the anchors of a model spawn."""
    if asked is not None:
        return asked
    return ROUNDS if gaussians <= MANY_GAUSSIANS else ROUNDS_OF_MANY


def rounds(training: Sequence[Camera], count: int) -> tuple[Sequence[Camera], ...]:
    """By which pictures colours are fitted again, round by round: from between the training cameras, others each time,
    for where the same places are looked at again and again, what suits them is learnt by heart; the last time by those
    of the photographs too."""
    inner = tuple(between(training, number, alone=True) for number in range(count - 1))
    return (*inner, [*training, *between(training, count - 1)]) if count else ()


def endless(training: Sequence[Camera]) -> Iterator[Camera]:
    """The training cameras and others between them, in random order, and so on: the others are never the same, nor any
    of `rounds`."""
    for number in count(BEYOND_ROUNDS):
        cameras = [*training, *between(training, number)]
        for i in np.random.default_rng(number).permutation(len(cameras)):
            yield cameras[i]


def between(cameras: Sequence[Camera], seed: int, alone: bool = False) -> list[Camera]:
    """Each camera that has neighbours somewhere between itself and these, in their mean by random weights, all equally
    likely, and turned a little. With `alone` also those that have none, turned where they are."""
    places = np.array([camera.position for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    generator = np.random.default_rng(seed)
    found = []
    for i, camera in enumerate(cameras):
        weights = generator.dirichlet(np.ones(NEIGHBOURS + 1))
        angles = generator.uniform(-1, 1, 3) * TURNED * np.arctan(camera.width / 2 / camera.fx)
        around = [i, *_alike(places, forward, i)]
        if len(around) > 1 or alone:
            own = weights[: len(around)] / weights[: len(around)].sum()
            found.append(_moved(camera, own @ places[around], Rotation.from_euler("xyz", angles).as_matrix()))
    return found


def _alike(places: Float[np.ndarray, "n 3"], forward: Float[np.ndarray, "n 3"], i: int) -> list[int]:
    """The nearest others that look the way of a camera, nearest first."""
    apart = np.where(forward @ forward[i] > LIKE, np.linalg.norm(places - places[i], axis=1), np.inf)
    apart[i] = np.inf
    order = np.argsort(apart, kind="stable")[:NEIGHBOURS]
    return [int(j) for j in order if np.isfinite(apart[j])]


def _moved(camera: Camera, position: Float[np.ndarray, "3"], turn: Float[np.ndarray, "3 3"]) -> Camera:
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ camera.camera_from_world[:3, :3]
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, camera_from_world=matrix)
