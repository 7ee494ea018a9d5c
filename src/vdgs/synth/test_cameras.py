"""Test and validation photographs: all over the place that the flight saw, its poorly seen parts included.

Every n-th photograph of a flight lies where the flight is dense. These are taken besides the flight instead: the
surface that it truly sees is cut into as many parts of like area as views are wanted, and one photograph is aimed at
each.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.vq import kmeans2

from vdgs.geometry.camera import Camera
from vdgs.synth.flight_cameras import make_camera, pose_from_angles
from vdgs.synth.options import ResolvedOptions
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.terrain import Terrain
from vdgs.synth.true_visibility import view_ground_truth

#: Share of a picture's surface that at least one, and at least two, training photographs must truly see (choice): where
#: nothing was seen there is nothing to measure.
_MIN_SEEN_ONCE, _MIN_SEEN_TWICE = 0.9, 0.75
#: How many poses are tried for a part before the best of them is taken.
_MAX_TRIES = 10
#: Tilts up to this (rad) are as good as any; where a part lies far off, the least tilt that reaches it is taken.
_EASY_TILT = np.radians(45)
_MAX_TILT = np.radians(62)


def make_test_cameras(
    tracer: RayTracer,
    terrain: Terrain,
    training: list[Camera],
    visible_points: np.ndarray,
    count: int,
    options: ResolvedOptions,
    rng: np.random.Generator,
) -> list[Camera]:
    """`count` cameras that look at places all over `seen` [n, 3] (m): what the training cameras truly see."""
    if count == 0:
        return []
    _, part = kmeans2(visible_points[:, :2], min(count, len(visible_points)), minit="++", seed=rng)
    return [
        _aim_camera(
            tracer,
            terrain,
            training,
            _central_point(visible_points[part == k] if (part == k).any() else visible_points),
            options,
            rng,
        )
        for k in range(count)
    ]


def _central_point(points: np.ndarray) -> np.ndarray:
    """The place nearest to the middle of some places [n, 3]."""
    away = np.linalg.norm(points[:, :2] - points[:, :2].mean(0), axis=1)
    return points[away.argmin()]


def _aim_camera(
    tracer: RayTracer,
    terrain: Terrain,
    training: list[Camera],
    target: np.ndarray,
    options: ResolvedOptions,
    rng: np.random.Generator,
) -> Camera:
    """A camera that looks at a place from where the drone has been, and of which training saw nearly everything."""
    best, best_share = None, -1.0
    for _ in range(_MAX_TRIES):
        camera = _pose(terrain, training, target, options, rng)
        depth, views = view_ground_truth(tracer, camera, training, step=max(1, options.width // 24))
        surface = np.isfinite(depth)
        once, twice = (views[surface] >= 1).mean(), (views[surface] >= 2).mean()
        if once >= _MIN_SEEN_ONCE and twice >= _MIN_SEEN_TWICE:
            return camera
        if once + twice > best_share:
            best, best_share = camera, once + twice
    assert best is not None
    return best


def _pose(
    terrain: Terrain, training: list[Camera], target: np.ndarray, options: ResolvedOptions, rng: np.random.Generator
) -> Camera:
    """One guess: from beside some training camera, at about its height, aimed somewhere about the target."""
    positions = np.stack([camera.position for camera in training])
    height = positions[:, 2] - target[2]
    spread = 0.25 * float(np.median(height))
    moved = positions + rng.normal(0, 1, positions.shape) * [spread, spread, 0.05 * spread]
    across = target[:2] - moved[:, :2] + rng.normal(0, 0.3 * spread, (len(moved), 2))
    tilt = np.arctan2(np.linalg.norm(across, axis=1), moved[:, 2] - target[2])
    easy = np.flatnonzero(tilt < _EASY_TILT)
    chosen = int(rng.choice(easy)) if len(easy) else int(tilt.argmin())
    x, y, _ = moved[chosen]
    climb = positions[chosen, 2] - float(terrain.height_without_ponds(*positions[chosen, :2]))
    position = np.array([x, y, float(terrain.height_without_ponds(x, y)) + climb * (1 + rng.normal(0, 0.02))])
    heading = np.arctan2(across[chosen, 0], across[chosen, 1])
    lean = min(float(tilt[chosen]), _MAX_TILT)
    return make_camera(pose_from_angles(position, lean, heading, np.radians(rng.normal(0, 1.5))), options)
