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
NUM_NEIGHBORS = 3
#: That is: whose directions are at most about 45 degrees apart (cosine).
MIN_DIRECTION_COSINE = 0.7
#: They are turned about each axis by up to this share of half of what a picture's width holds, so as to look at what no
#: photograph nearby shows too: seen from afar alone, it would take any color (docs/export.md).
MAX_TURN_SHARE = 0.5
#: So many times colors are fitted again, and how often where anchors spawn more Gaussians than that.
DEFAULT_COLOR_ITERATIONS, LARGE_SCENE_COLOR_ITERATIONS, LARGE_SCENE_GAUSSIANS = 8, 1, 4_000_000
#: No seed of `color_iteration_cameras` reaches here.
FIRST_ENDLESS_SEED = 1000


def color_iteration_count(requested: int | None, gaussians: int) -> int:
    """How many rounds, for so many Gaussians that the anchors of a model spawn."""
    if requested is not None:
        return requested
    return DEFAULT_COLOR_ITERATIONS if gaussians <= LARGE_SCENE_GAUSSIANS else LARGE_SCENE_COLOR_ITERATIONS


def color_iteration_cameras(training: Sequence[Camera], count: int) -> tuple[Sequence[Camera], ...]:
    """By which pictures colors are fitted again, round by round: from between the training cameras, others each time,
    for where the same places are looked at again and again, what suits them is learnt by heart; the last time by those
    of the photographs too."""
    inner = tuple(novel_cameras(training, number, include_isolated=True) for number in range(count - 1))
    return (*inner, [*training, *novel_cameras(training, count - 1)]) if count else ()


def endless_cameras(training: Sequence[Camera]) -> Iterator[Camera]:
    """The training cameras and others between them, in random order, and so on: the others are never the same, nor any
    of `color_iteration_cameras`."""
    for number in count(FIRST_ENDLESS_SEED):
        cameras = [*training, *novel_cameras(training, number)]
        for i in np.random.default_rng(number).permutation(len(cameras)):
            yield cameras[i]


def novel_cameras(cameras: Sequence[Camera], seed: int, include_isolated: bool = False) -> list[Camera]:
    """Each camera that has neighbors somewhere between itself and these, in their mean by random weights, all equally
    likely, and turned a little. With `include_isolated` also those that have none, turned where they are."""
    places = np.array([camera.position for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    generator = np.random.default_rng(seed)
    found = []
    for i, camera in enumerate(cameras):
        weights = generator.dirichlet(np.ones(NUM_NEIGHBORS + 1))
        angles = generator.uniform(-1, 1, 3) * MAX_TURN_SHARE * np.arctan(camera.width / 2 / camera.fx)
        around = [i, *_similar_cameras(places, forward, i)]
        if len(around) > 1 or include_isolated:
            own = weights[: len(around)] / weights[: len(around)].sum()
            found.append(_move_camera(camera, own @ places[around], Rotation.from_euler("xyz", angles).as_matrix()))
    return found


def _similar_cameras(positions: Float[np.ndarray, "n 3"], forward: Float[np.ndarray, "n 3"], i: int) -> list[int]:
    """The nearest others that look the way of a camera, nearest first."""
    apart = np.where(
        forward @ forward[i] > MIN_DIRECTION_COSINE, np.linalg.norm(positions - positions[i], axis=1), np.inf
    )
    apart[i] = np.inf
    order = np.argsort(apart, kind="stable")[:NUM_NEIGHBORS]
    return [int(j) for j in order if np.isfinite(apart[j])]


def _move_camera(camera: Camera, position: Float[np.ndarray, "3"], turn: Float[np.ndarray, "3 3"]) -> Camera:
    matrix = np.eye(4)
    matrix[:3, :3] = turn @ camera.camera_from_world[:3, :3]
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return replace(camera, camera_from_world=matrix)
