"""Where anchors start: on the voxel grid of the sparse points and of what stereo adds to them, outliers left out and
gaps filled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int64
from scipy.spatial import cKDTree

from vdgs.config.method import InitConfig
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import FEATURE_SIZE
from vdgs.model.anchors import Anchors
from vdgs.model.initialization.gap_filling import find_gap_points
from vdgs.model.levels import mean_spacing

#: An outlier is known by its distance to this neighbor: small clusters of false matches are outliers too.
OUTLIER_NEIGHBOR = 4


def auto_voxel_size(points: np.ndarray) -> float:
    """Median distance of the points [n, 3] to their nearest other point (choice; upstream forgets the root).

    Coincident points are counted once. Raises VdgsError with fewer than two distinct points.
    """
    distinct = np.unique(points, axis=0)
    if len(distinct) < 2:
        raise VdgsError(
            f"The capture has {len(distinct)} distinct sparse point(s); at least 2 are needed to place anchors. "
            "Run the structure-from-motion again, or give --init.voxel-size."
        )
    distances, _ = cKDTree(distinct).query(distinct, k=2, workers=1)
    return float(np.median(distances[:, 1]))


def inlier_mask(points: np.ndarray, factor: float) -> np.ndarray:
    """Which points [n, 3] have their fourth nearest neighbor within `factor` times the median such distance."""
    if factor <= 0 or len(points) <= OUTLIER_NEIGHBOR:
        return np.ones(len(points), bool)
    distances, _ = cKDTree(points).query(points, k=[OUTLIER_NEIGHBOR + 1], workers=1)
    limit = factor * np.median(distances)
    return distances[:, 0] <= limit if limit > 0 else np.ones(len(points), bool)


def get_voxel_size(points: np.ndarray, config: InitConfig) -> float:
    """The edge of the voxel grid of the sparse points [n, 3]. Raises VdgsError as `auto_voxel_size`."""
    return config.voxel_size if config.voxel_size > 0 else auto_voxel_size(points)


def initialize_anchors(
    points: np.ndarray,
    colors: np.ndarray,
    cameras: Sequence[Camera],
    config: InitConfig,
    num_offsets: int,
    dense: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[Anchors, float]:
    """Anchors on the voxel grid of the sparse points [n, 3], and the voxel used.

    Points are rounded to the grid and made unique (Scaffold-GS eq. 3); so are the `dense` ones [m, 3], with their
    colors, that stereo found beside them, and those that fill gaps seen by the training cameras. Log-scales start at
    the logarithm of the mean distance to the three nearest other anchors, offsets at 0, features at 0 or at the
    colors. Raises VdgsError with fewer than two distinct points.
    """
    voxel = get_voxel_size(points, config)
    inliers = inlier_mask(points, config.outlier_distance)
    points, colors = points[inliers], colors[inliers]
    if dense is not None:
        points, colors = (np.concatenate(pair) for pair in zip((points, colors), dense, strict=True))
    if config.fill_gaps:
        gaps = find_gap_points(points, cameras, voxel)
        nearest = cKDTree(points).query(gaps, workers=1)[1] if len(gaps) else np.zeros(0, np.int64)
        points, colors = np.concatenate([points, gaps]), np.concatenate([colors, colors[nearest]])
    cells, owner = np.unique(np.round(points / voxel).astype(np.int64), axis=0, return_inverse=True)
    positions = cells * voxel
    n, spacing = len(positions), mean_spacing(positions, voxel)
    features = np.zeros((n, FEATURE_SIZE))
    if config.from_colors:
        features[:, :3] = _mean_colors(colors, owner.reshape(-1), n) * 2.0 - 1.0
    as_tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))  # noqa: E731
    offsets = torch.zeros(n, num_offsets, 3, dtype=torch.float32, device="cpu")
    log_scales = np.repeat(np.log(spacing)[:, None], 6, axis=1)
    return Anchors(as_tensor(positions), as_tensor(features), offsets, as_tensor(log_scales)), voxel


def _mean_colors(colors: np.ndarray, owner: Int64[np.ndarray, " n"], count: int) -> np.ndarray:
    """Mean color in [0, 1] of the points that share a cell, [count, 3]."""
    sums = np.stack([np.bincount(owner, colors[:, c] / 255.0, count) for c in range(3)], axis=1)
    return sums / np.bincount(owner, minlength=count)[:, None]
