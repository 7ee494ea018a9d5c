"""Visibility: how many training cameras hold each anchor in their frustum (sections IV-B and IV-C).

A frustum holds a point where z > near and the projected center lies on the image. Nothing is hidden behind anything
else: the paper counts frusta, not lines of sight. Symbols: V_i (views of anchor i), V̂_i (normalized), c_k (share of
the cameras of a growth cycle).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels import get_backend

#: Percentiles and limits by which visibility is described.
PERCENTILES = (5, 25, 50, 75, 95)
LOW_VISIBILITY_LIMITS = (3, 5, 10)
#: Keeps V̂ finite where all anchors are seen alike (eq. 5).
EPSILON = 1e-8
#: In the viewer and in films a scene fades out where fewer cameras see it (choice): two are needed to fix a depth.
FADE_BELOW = 2
#: It has faded out where it lies so far beyond a picture's edge, as a share of the longer side (choice).
FADE_MARGIN = 0.15


@dataclass(frozen=True)
class VisibilityStats:
    """How unevenly anchors are seen."""

    mean: float
    #: V by percentile.
    quantiles: dict[int, float]
    #: Gini coefficient of V: 0 where all are seen alike, towards 1 where few anchors have all the views.
    gini: float
    #: Share of the anchors that fewer than so many cameras see.
    fraction_below: dict[int, float]


def count_visibility(positions: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Int32[Tensor, " n"]:
    """V_i of every anchor: the number of `cameras` (the training views) whose frustum holds it.

    Raises TypeError or ValueError unless positions are float32 or float64 [n, 3].
    """
    return get_backend(positions.device).count_visibility(positions, cameras)


def fade_factors(
    positions: Float[Tensor, "n 3"], cameras: Sequence[Camera], min_visibility: int
) -> Float[Tensor, " n"]:
    """What opacities are multiplied with where a scene fades out at its edge, by V of each place: 1 where at least
    `min_visibility` cameras hold it; farther out it falls smoothly to 0, by how much larger pictures would have to be
    for so many to hold it, as a share of `FADE_MARGIN`. Raises TypeError or ValueError as `count_visibility`."""
    return get_backend(positions.device).fade_factors(positions, cameras, min_visibility, FADE_MARGIN)


class NearbyCameras:
    """Which of many cameras may see some places, or fade them out: of a scene's part few do, and V asks no others."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self.cameras = list(cameras)
        self._is_pinhole = np.array([each.model == "pinhole" for each in cameras], bool)
        poses = np.array([each.camera_from_world for each in cameras]).reshape(-1, 4, 4)
        lenses = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras]).reshape(-1, 6).T
        #: Of the pictures widened by `FADE_MARGIN`, and of the pictures; a pixel more and less: no rounding counts.
        self._widened = _frustum_planes(poses, lenses, FADE_MARGIN * np.maximum(*lenses[4:]) + 1, near=0.0)
        self._planes = _frustum_planes(poses, lenses, -1.0, near=NEAR_PLANE)

    def of(self, positions: Float[Tensor, "p 3"]) -> list[Camera]:
        """Those whose pictures, widened by `FADE_MARGIN`, reach the sphere about these places; others count none."""
        return [self.cameras[k] for k in self.indices(positions)]

    def indices(self, positions: Float[Tensor, "p 3"]) -> Int[np.ndarray, " near"]:
        """The numbers of those cameras, ascending."""
        return self._reached(*_sphere(positions)) if len(positions) else np.zeros(0, np.int64)

    def fade_factors(self, positions: Float[Tensor, "p 3"], min_visibility: int) -> Float[Tensor, " p"]:
        """`fade_factors` of all the cameras. Where too few reach the sphere about the places, or enough of them hold
        all of it, none of these is looked at."""
        if not len(positions):
            return positions.new_zeros(0)
        center, radius = _sphere(positions)
        near = self._reached(center, radius)
        if len(near) < min_visibility:
            return positions.new_zeros(len(positions))
        hold = self._is_pinhole[near] & (_least_distances(self._planes[:, near], center) > radius)
        if hold.sum() >= min_visibility:
            return positions.new_ones(len(positions))
        return fade_factors(positions, [self.cameras[k] for k in near], min_visibility)

    def _reached(self, center: Float[np.ndarray, "3"], radius: float) -> Int[np.ndarray, " near"]:
        """The numbers of the cameras whose widened pictures reach a sphere."""
        if not np.isfinite(radius):
            return np.arange(len(self.cameras))
        return np.flatnonzero(~self._is_pinhole | (_least_distances(self._widened, center) >= -radius))


def _sphere(positions: Float[Tensor, "p 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """The center and the radius of a sphere about some places."""
    low, high = (bound.double().cpu().numpy() for bound in torch.aminmax(positions.detach(), dim=0))
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def _frustum_planes(
    poses: Float[np.ndarray, "c 4 4"], lenses: Float[np.ndarray, "6 c"], more: Float[np.ndarray, " c"] | float,
    near: float,
) -> Float[np.ndarray, "5 c 4"]:  # fmt: skip
    """Planes in the world, unit normals inwards and offsets: so far before each camera, and through its center and the
    edges of its picture (fx, fy, cx, cy, width, height), so many pixels larger on each side."""
    fx, fy, cx, cy, width, height = lenses
    zero, one = np.zeros_like(fx), np.ones_like(fx)
    normals = np.stack([
        np.stack([zero, zero, one], -1),
        np.stack([fx, zero, cx + more], -1), np.stack([-fx, zero, width - cx + more], -1),
        np.stack([zero, fy, cy + more], -1), np.stack([zero, -fy, height - cy + more], -1),
    ], 1)  # fmt: skip
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    planes = normals @ poses[:, :3]
    planes[:, 0, 3] -= near
    return np.ascontiguousarray(planes.transpose(1, 0, 2))


def _least_distances(planes: Float[np.ndarray, "5 c 4"], place: Float[np.ndarray, "3"]) -> Float[np.ndarray, " c"]:
    """How far inside of the frustum of each camera a place is."""
    least: np.ndarray = (planes @ np.append(place, 1.0)).min(axis=0)
    return least


def visibility_sampling_weights(positions: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> tuple[float, ...]:
    """Sampling weights of cameras (choice): w_j = sum of 1 / V_i over the anchors i that camera j holds, so that each
    anchor divides one vote among its cameras. All are 1 if no anchor is held."""
    votes = 1.0 / count_visibility(positions, cameras).double().clamp(min=1)
    shares = tuple(float(votes[count_visibility(positions, [camera]) > 0].sum()) for camera in cameras)
    return shares if any(shares) else (1.0,) * len(cameras)


def effective_sample_size(shares: Sequence[float]) -> float:
    """(Σ w)² / Σ w² (Kish, Survey Sampling, 1965, section 11.7) for `shares`, of which at least one is above 0."""
    return sum(shares) ** 2 / sum(share * share for share in shares)


def normalize_visibility(visibility: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """V̂_i = (V_i - min V) / (max V - min V + 1e-8), float64 in [0, 1) (eq. 5)."""
    count = np.asarray(visibility, np.float64)
    if len(count) == 0:
        return count
    return (count - count.min()) / (np.ptp(count) + EPSILON)


def visibility_ratio(positions: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """c_k of every anchor (eq. 8): the share of the distinct cameras of a growth cycle whose frustum holds it, float32.
    A view at two resolutions counts once. Raises ValueError without cameras."""
    if not cameras:
        raise ValueError("a growth cycle without cameras has no shares")
    distinct = list({_frustum(camera): camera for camera in cameras}.values())
    return count_visibility(positions, distinct).float() / len(distinct)


def _frustum(camera: Camera) -> tuple[bytes, tuple[float, ...], str]:
    """What makes two cameras see the same: pose, and intrinsics as shares of the image."""
    across, down = camera.width, camera.height
    shares = (camera.fx / across, camera.fy / down, camera.cx / across, camera.cy / down)
    return camera.camera_from_world.tobytes(), tuple(round(share, 9) for share in shares), camera.model


def visibility_stats(visibility: Int[np.ndarray, " n"]) -> VisibilityStats:
    """The distribution of V in numbers. Raises ValueError if there is no anchor."""
    count = np.asarray(visibility, np.float64)
    if len(count) == 0:
        raise ValueError("no anchors: their visibility has no distribution")
    return VisibilityStats(
        mean=float(count.mean()),
        quantiles={percent: float(np.percentile(count, percent)) for percent in PERCENTILES},
        gini=_gini(count),
        fraction_below={limit: float((count < limit).mean()) for limit in LOW_VISIBILITY_LIMITS},
    )


def _gini(values: Float[np.ndarray, " n"]) -> float:
    """Half the mean absolute difference of two values, over their mean; from sorted values in O(n log n)."""
    total = values.sum()
    if total == 0:
        return 0.0
    n = len(values)
    ranks = 2 * np.arange(1, n + 1) - n - 1
    return float((ranks * np.sort(values)).sum() / (n * total))
