"""Sparse points as structure from motion would find them, but with true tracks.

Places on true surfaces are drawn from every picture, more where it has texture, and followed into
every other picture in which they are seen: inside the frame and not occluded. Observations carry pixel
noise; each point is where bundle adjustment with known poses would put it, given that noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.synth.image_renderer import pixel_rays
from vdgs.synth.ray_tracing import RayTracer
from vdgs.synth.true_visibility import visibility_matrix

#: Pictures that look at a place from directions further apart than this are never matched (degrees).
_MAX_VIEW_ANGLE_DEG = 65.0
#: Pairs of a place and a picture whose directions are in memory at once.
_PAIRS_PER_CHUNK = 4_000_000


@dataclass(frozen=True, eq=False)
class SeedPoints:
    """Places [n, 3] (m, float64) picked in one image, and their colors [n, 3] uint8."""

    points: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseCloud:
    """True places and noisy points [n, 3] (m), colors [n, 3] uint8, mean reprojection errors [n] (px);
    observations: point index [m], image index [m], pixels [m, 2], sorted by point, then by image;
    visibility [n, images]: in the frame and not occluded (a superset of the observations); outliers [n]: matched
    wrongly, so that the point is not where its place is."""

    true_points: np.ndarray
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    observed_point: np.ndarray
    observed_image: np.ndarray
    observed_px: np.ndarray
    visibility: np.ndarray
    outliers: np.ndarray


def sample_seed_points(
    tracer: RayTracer, camera: Camera, image: np.ndarray, count: int, rng: np.random.Generator
) -> SeedPoints:
    """About `count` surface places seen in an image [height, width, 3] uint8, denser where it has texture."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    weight = (np.minimum(cv2.GaussianBlur(slope, (0, 0), 1.0), 150) + 4).astype(np.float64).ravel()
    chosen = rng.choice(len(weight), min(count, len(weight)), replace=False, p=weight / weight.sum())
    row, column = np.divmod(chosen, camera.width)
    pixels = np.stack([column, row], 1) + rng.uniform(0.02, 0.98, (len(chosen), 2))
    origins, directions = pixel_rays(camera, pixels)
    hits = tracer.intersect(origins, directions)
    met = (hits.triangle >= 0) & (hits.distance < 600)
    places = origins + directions.astype(np.float64) * hits.distance[:, None]
    return SeedPoints(places[met], image[row, column][met])


def _recognized_views(
    cameras: list[Camera], places: np.ndarray, home: np.ndarray, visible: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """In which of the pictures that see it a place is also recognized: the likelier, the nearer to the
    direction of the picture it was found in (`home`), [n, cameras] bool."""
    positions = np.stack([camera.position for camera in cameras])
    matched = np.zeros_like(visible)
    step = max(1, _PAIRS_PER_CHUNK // len(cameras))
    for start in range(0, len(places), step):
        some = slice(start, start + step)
        ray = places[some, None] - positions
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        own = ray[np.arange(len(ray)), home[some]]
        apart = np.degrees(np.arccos(np.clip(np.einsum("nkc,nc->nk", ray, own), -1, 1)))
        chance = 0.9 * np.clip(1 - apart / _MAX_VIEW_ANGLE_DEG, 0, 1)
        matched[some] = visible[some] & (rng.random(chance.shape) < chance)
    matched[np.arange(len(places)), home] = visible[np.arange(len(places)), home]
    return matched


def observations_by_image(image: np.ndarray, count: int) -> list[np.ndarray]:
    """The observations of each of `count` images, ascending; `image` [m] says of which each is."""
    ends = np.cumsum(np.bincount(image, minlength=count))
    return np.split(np.argsort(image, kind="stable"), ends[:-1])


def _refine_points(
    cameras: list[Camera], places: np.ndarray, point: np.ndarray, image: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """One Gauss-Newton step from the true places under noisy observations: points [n, 3].

    Solves sum_i J_i^T J_i dx = sum_i J_i^T noise_i with J_i the derivative of the projection.
    """
    normal = np.zeros((len(places), 3, 3))
    right = np.zeros((len(places), 3))
    for camera, at in zip(cameras, observations_by_image(image, len(cameras)), strict=True):
        rotation = camera.camera_from_world[:3, :3]
        local = places[point[at]] @ rotation.T + camera.camera_from_world[:3, 3]
        x, y, z = local.T
        zero = np.zeros_like(z)
        du = np.stack([camera.fx / z, zero, -camera.fx * x / z**2], 1)
        dv = np.stack([zero, camera.fy / z, -camera.fy * y / z**2], 1)
        jacobian = np.stack([du, dv], 1) @ rotation
        np.add.at(normal, point[at], np.einsum("nij,nik->njk", jacobian, jacobian))
        np.add.at(right, point[at], np.einsum("nij,ni->nj", jacobian, noise[at]))
    damping = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return places + np.linalg.solve(normal + damping, right[..., None])[..., 0]


def make_sparse_cloud(
    tracer: RayTracer,
    cameras: list[Camera],
    seeds: list[SeedPoints],
    count: int,
    noise_px: float,
    rng: np.random.Generator,
) -> SparseCloud:
    """At most `count` points out of the seeds of all images (`seeds[k]` from `cameras[k]`), all seen in
    at least two pictures. O(points x images): a byte of memory for each."""
    places = np.concatenate([seed.points for seed in seeds])
    colors = np.concatenate([seed.colors for seed in seeds])
    home = np.repeat(np.arange(len(seeds)), [len(seed.points) for seed in seeds])
    visible = visibility_matrix(tracer, cameras, places)
    matched = _recognized_views(cameras, places, home, visible, rng)
    good = np.flatnonzero(matched.sum(1) >= 2)
    kept = np.sort(rng.permutation(good)[:count])
    places, colors, visible, matched = places[kept], colors[kept], visible[kept], matched[kept]
    point, image = np.nonzero(matched)
    truth = np.empty((len(point), 2))
    of_image = observations_by_image(image, len(cameras))
    for camera, at in zip(cameras, of_image, strict=True):
        truth[at] = camera.project(places[point[at]])[0]
    noise = rng.normal(0, noise_px, truth.shape) if noise_px > 0 else np.zeros_like(truth)
    points = _refine_points(cameras, places, point, image, noise)
    observed = truth + noise
    residual = np.empty(len(point))
    for camera, at in zip(cameras, of_image, strict=True):
        residual[at] = np.linalg.norm(camera.project(points[point[at]])[0] - observed[at], axis=1)
    errors = np.bincount(point, residual, len(places)) / np.maximum(np.bincount(point, minlength=len(places)), 1)
    return SparseCloud(
        true_points=places, points=points, colors=colors, errors=errors, observed_point=point, observed_image=image,
        observed_px=observed, visibility=visible, outliers=np.zeros(len(places), bool),
    )  # fmt: skip
