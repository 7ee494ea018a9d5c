"""What real captures suffer from: changing exposure, poses that are a little off, points that are plain wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.geometry.similarity import rotation_about
from vdgs.synth.synthetic_points import SparseCloud

#: Exposure keeps this share of its deviation from one photograph to the next: clouds drift, they do not flicker.
_EXPOSURE_DRIFT = 0.85
#: Color temperature drifts along with exposure, by this share of it.
_TINT = 0.2
#: Mismatches put a point at its true distance times exp of a normal deviate of this size, and reproject worse.
_OUTLIER_SHIFT = 0.35
_OUTLIER_ERROR_PX = 3.0


def exposure_gains(count: int, stops: float, rng: np.random.Generator) -> np.ndarray:
    """Linear gain per photograph and channel, [n, 3]: a drift with a standard deviation of `stops`."""
    steps = rng.normal(0, 1, (count, 2)) * np.sqrt(1 - _EXPOSURE_DRIFT**2)
    walk = np.empty((count, 2))
    level = rng.normal(0, 1, 2)
    for k in range(count):
        level = _EXPOSURE_DRIFT * level + steps[k]
        walk[k] = level
    exposure, warmth = stops * walk[:, :1], _TINT * stops * walk[:, 1:]
    return np.exp2(exposure + warmth * np.array([1.0, 0.0, -1.0]))


def perturb_cameras(cameras: list[Camera], noise_px: float, altitude: float, rng: np.random.Generator) -> list[Camera]:
    """Cameras as a solver would give them: turned and moved so that pictures taken from `altitude` (m) shift by
    `noise_px` (standard deviation per axis), half the variance by turning and half by moving."""
    if noise_px == 0:
        return list(cameras)
    result = []
    for camera in cameras:
        angle = noise_px / np.sqrt(2) / camera.fx
        turn = rotation_about(rng.normal(0, angle, 3))
        rigid = camera.camera_from_world.copy()
        position = camera.position + rng.normal(0, angle * altitude, 3)
        rigid[:3, :3] = turn @ rigid[:3, :3]
        rigid[:3, 3] = -rigid[:3, :3] @ position
        result.append(replace(camera, camera_from_world=rigid))
    return result


def add_outliers(cloud: SparseCloud, cameras: list[Camera], share: float, rng: np.random.Generator) -> SparseCloud:
    """The cloud with a share of its points matched wrongly: each lies at a wrong distance along the ray of its first
    photograph (so many below ground, so many in the air) and is observed in two photographs only."""
    count = round(share * len(cloud.points))
    if count == 0:
        return cloud
    strays = np.sort(rng.choice(len(cloud.points), count, replace=False))
    points, errors, outliers = cloud.points.copy(), cloud.errors.copy(), cloud.outliers.copy()
    first = np.searchsorted(cloud.observed_point, strays)
    origins = np.stack([cameras[k].position for k in cloud.observed_image[first]])
    points[strays] = origins + (points[strays] - origins) * np.exp(rng.normal(0, _OUTLIER_SHIFT, (count, 1)))
    errors[strays] += np.abs(rng.normal(0, _OUTLIER_ERROR_PX, count))
    outliers[strays] = True
    rank = np.arange(len(cloud.observed_point)) - np.searchsorted(cloud.observed_point, cloud.observed_point)
    kept = ~outliers[cloud.observed_point] | (rank < 2)
    return replace(
        cloud, points=points, errors=errors, outliers=outliers, observed_point=cloud.observed_point[kept],
        observed_image=cloud.observed_image[kept], observed_px=cloud.observed_px[kept],
    )  # fmt: skip
