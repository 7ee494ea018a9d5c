"""Levels of anchors and which of them a view shows (Octree-GS sections 4.1 and 4.2). Pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from scipy.spatial import cKDTree
from torch import Tensor

from experiments.baselines.octree_gs.settings import FORK, OctreeConfig
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import FEATURE_SIZE
from vdgs.model.anchors import Anchors

#: Smallest squared distance to neighbors that a size starts from (program).
MIN_SQUARED_SPACING = 1e-7
#: Distances are taken of so many points at most.
MAX_POINTS = 100_000


@dataclass(frozen=True)
class Octree:
    """What says which level a place needs in a view. Level 0 has the coarsest cells."""

    num_levels: int
    #: The level up to which anchors are shown from the first iteration.
    first_open: int
    #: Edge of the cells of level 0, in units of the ground frame.
    voxel: float
    #: From this distance on level 0 is enough.
    distance: float
    round_down: bool = False

    def cell(self, level: int) -> float:
        return self.voxel / FORK**level

    def open_levels(self, iteration: int, config: OctreeConfig) -> int:
        """How many levels a training view may show at an iteration (from 0): coarse ones first."""
        steps = self.num_levels - 1 - self.first_open
        if steps <= 0 or config.progressive_share <= 0:
            return self.num_levels
        ratio, length = 1 / config.progressive_factor, config.progressive_share * config.training.iterations
        intervals = length * (1 - ratio) / (1 - ratio**steps) * ratio ** np.arange(steps)
        return self.first_open + 1 + int(np.searchsorted(np.cumsum(intervals), iteration))

    def shown(
        self, positions: Float[Tensor, "n 3"], levels: Int32[Tensor, " n"], bias: Float[Tensor, " n"] | float,
        camera: Camera, num_open: int,
    ) -> Bool[Tensor, " n"]:  # fmt: skip
        """Which anchors a view shows: those of no finer level than their distance, and their bias, ask for."""
        distance = (positions - torch.as_tensor(camera.position).to(positions)).norm(dim=1)
        wanted = torch.log2(self.distance / distance) + bias
        return levels <= (wanted.floor() if self.round_down else wanted.round()).clamp(0, num_open - 1)


def fit_octree(points: Float[np.ndarray, "p 3"], cameras: Sequence[Camera], config: OctreeConfig) -> Octree:
    """The octree of a capture, from its sparse points and how far the cameras are from them."""
    voxel = auto_voxel(points)
    if config.levels == 1:
        return Octree(1, 0, voxel, 1.0)
    some = points[:: max(1, len(points) // MAX_POINTS)]
    ends = [1 - config.distance_quantile, config.distance_quantile]
    reached = [np.quantile(np.linalg.norm(some - camera.position, axis=1), ends) for camera in cameras]
    nearest, farthest = np.quantile(np.array(reached), ends)
    levels = config.levels or round(float(np.log2(farthest / max(nearest, 1e-9)) / np.log2(FORK))) + 1
    first_open = levels // 2
    coarsest = voxel * FORK ** max(first_open - 1, 0)
    return Octree(levels, first_open, coarsest, float(farthest), config.round_down)


def auto_voxel(points: Float[np.ndarray, "p 3"]) -> float:
    """Root of the median mean squared distance to the three nearest points. Raises VdgsError with fewer than two
    distinct points."""
    distinct = np.unique(points, axis=0)
    if len(distinct) < 2:
        raise VdgsError(f"The capture has {len(distinct)} distinct sparse point(s); at least 2 are needed.")
    return float(np.sqrt(np.median(_squared_spacing(distinct))))


def octree_starts(
    points: Float[np.ndarray, "p 3"], cameras: Sequence[Camera], octree: Octree, num_offsets: int
) -> tuple[Anchors, Int32[Tensor, " n"]]:
    """An anchor in each cell of each level that holds a sparse point and that some camera shows, and their levels."""
    cells = [np.unique(np.round(points / octree.cell(level)), axis=0) for level in range(octree.num_levels)]
    positions = np.concatenate([cell * octree.cell(level) for level, cell in enumerate(cells)])
    levels = torch.from_numpy(np.repeat(np.arange(octree.num_levels, dtype=np.int32), [len(cell) for cell in cells]))
    places = torch.from_numpy(positions.astype(np.float32))
    kept = shown_anywhere(octree, places, levels, cameras)
    spacing = np.maximum(_squared_spacing(positions[kept.numpy()]), MIN_SQUARED_SPACING)
    log_scales = torch.from_numpy((0.5 * np.log(spacing)).astype(np.float32))
    n = int(kept.sum())
    anchors = Anchors(
        places[kept], torch.zeros(n, FEATURE_SIZE), torch.zeros(n, num_offsets, 3), log_scales[:, None].repeat(1, 6)
    )
    return anchors, levels[kept]


def shown_anywhere(
    octree: Octree, positions: Float[Tensor, "n 3"], levels: Int32[Tensor, " n"], cameras: Sequence[Camera]
) -> Bool[Tensor, " n"]:
    """Which anchors at least one camera is near enough to show, wherever it looks."""
    if octree.num_levels == 1:
        return torch.ones_like(levels, dtype=torch.bool)
    seen = torch.zeros_like(levels, dtype=torch.bool)
    for camera in cameras:
        seen |= octree.shown(positions, levels, 0.0, camera, octree.num_levels)
    return seen


def _squared_spacing(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
    """Mean squared distance to the three nearest others; ones for a single point."""
    if len(points) < 2:
        return np.ones(len(points))
    distances, _ = cKDTree(points).query(points, k=min(4, len(points)), workers=1)
    return (distances[:, 1:] ** 2).mean(axis=1)
