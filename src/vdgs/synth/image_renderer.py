"""Photographs of the town from a camera, and the rays of their pixels."""

from __future__ import annotations

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth.lighting import SkyMap, tone_map
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.shading import radiance
from vdgs.synth.town import Town

#: Rays shaded at a time: their arrays stay in the cache.
_CHUNK = 1 << 16
#: How far samples spread beyond their pixel: a little softness against aliasing.
_SAMPLE_SPREAD = 1.15


def pixel_sample_offsets(count: int) -> np.ndarray:
    """Places of a pixel's samples around its centre, [count, 2] in pixels: rotated grid or R2 sequence."""
    if count == 1:
        return np.zeros((1, 2))
    if count == 4:
        return _SAMPLE_SPREAD * np.array([(-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125)])
    k = np.arange(count)[:, None]
    offsets = (0.5 + k * np.array([0.7548776662466927, 0.5698402909980532])) % 1
    return _SAMPLE_SPREAD * (offsets - offsets.mean(0))


def pixel_rays(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions [n, 3] float32 of the rays through image places [n, 2] (pixels)."""
    rotation = camera.camera_from_world[:3, :3]
    local = np.stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(pixels))], 1
    )
    directions = local @ rotation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.position, directions.shape)
    return origins.astype(np.float32), directions.astype(np.float32)


def pixel_centers(camera: Camera) -> np.ndarray:
    """Image places of all pixel centres, row by row, [height * width, 2]."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], 1)


def render_image(
    town: Town, tracer: RayTracer, sky: SkyMap, camera: Camera, samples: int, gain: np.ndarray
) -> np.ndarray:
    """The picture that a camera takes, [height, width, 3] uint8; `gain` [3] is its exposure, per channel."""
    centers, offsets = pixel_centers(camera), pixel_sample_offsets(samples)
    step = max(1, _CHUNK // samples)
    rows = []
    for start in range(0, len(centers), step):
        pixels = centers[start : start + step, None] + offsets
        rays = pixel_rays(camera, pixels.reshape(-1, 2))
        light, _ = radiance(town, tracer, sky, *rays, 1 / camera.fx)
        rows.append(tone_map(light.reshape(-1, samples, 3).mean(1) * gain.astype(np.float32)))
    values = np.concatenate(rows).reshape(camera.height, camera.width, 3)
    return (values * 255 + 0.5).astype(np.uint8)
