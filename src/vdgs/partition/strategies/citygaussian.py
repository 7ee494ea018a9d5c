"""CityGaussian's partition: a uniform grid in contracted space, cameras by what a block's absence changes.

Liu et al., CityGaussian: Real-time High-quality Large-Scale Scene Rendering with Gaussians, ECCV 2024, section 3.2.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float

from vdgs.config.method import AssignmentConfig
from vdgs.geometry.camera import Camera
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.blocks import Block, Blocks
from vdgs.partition.strategies.strategy import checked_xy, grid_shape, nonempty_cells

#: The foreground lies between these quantiles of the cameras; beyond it space is contracted (choice: the publication
#: sets it by hand for each scene).
FOREGROUND_QUANTILES = (0.1, 0.9)
#: Points on each side of a cell: its sides are curves outside the foreground.
POINTS_PER_SIDE = 24
#: A camera joins where leaving the block out changes 1 - SSIM by more (the publication: 0.05 to 0.12).
DISSIMILARITY_THRESHOLD = 0.08


@dataclass(frozen=True)
class CityGaussian:
    """Uniform grid after contraction; 1 - SSIM without the block, or the camera stands in it."""

    citation: str = "Liu et al., CityGaussian, ECCV 2024"
    omissions: tuple[str, ...] = (
        "a block moves the anchors of its own cell; there all Gaussians of the coarse model move, and the cell is kept",
        "levels of detail, compression",
    )

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        """Equal cells of the contracted square [-2, 2]², as far out as there are anchors."""
        ground = checked_xy(positions)
        centers = np.array([camera.position[:2] for camera in cameras], np.float64)
        low, high = np.quantile(centers, FOREGROUND_QUANTILES, axis=0)
        middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
        contracted = contract((ground - middle) / half)
        reach = min(float(np.abs(contracted).max()) + 1e-3, 1.999)
        extent = np.ptp(np.quantile(contracted, (0.01, 0.99), axis=0), axis=0)
        columns, rows = grid_shape(count, float(extent[0] / max(extent[1], 1e-9)))
        across, up = (np.linspace(-2, 2, n + 1).clip(-reach, reach) for n in (columns, rows))
        cells = []
        for x0, x1 in itertools.pairwise(across):
            for y0, y1 in itertools.pairwise(up):
                core = shapely.Polygon(expand(_outline(x0, y0, x1, y1)) * half + middle).buffer(0)
                if isinstance(core, shapely.Polygon) and not core.is_empty:
                    cells.append(Block(core, core))
        return nonempty_cells(cells, ground, count)

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        return replace(config, mode="leave-one-out", threshold_leave_one_out=DISSIMILARITY_THRESHOLD)

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        """A camera also joins the block that it stands in: its score there is the highest possible."""
        changed = scores.scores.copy()
        changed[np.arange(len(changed)), scores.nadir_block] = 1.0
        return replace(scores, scores=changed)


def contract(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """x where |x|∞ <= 1, else (2 - 1 / |x|∞) x / |x|∞: the plane within the square [-2, 2]²."""
    norm = np.maximum(np.abs(points).max(axis=1, keepdims=True), 1.0)
    return (2 - 1 / norm) * points / norm


def expand(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The inverse of `contract`, within the open square (-2, 2)²."""
    norm = np.maximum(np.abs(points).max(axis=1, keepdims=True), 1.0)
    return points / (norm * (2 - norm))


def _outline(x0: float, y0: float, x1: float, y1: float) -> Float[np.ndarray, "m 2"]:
    """Points about a rectangle; neighbours share those on their common side."""
    x, y = _side(x0, x1), _side(y0, y1)
    bottom, right = np.column_stack([x, np.full(len(x), y0)]), np.column_stack([np.full(len(y), x1), y])
    top, left = np.column_stack([x[::-1], np.full(len(x), y1)]), np.column_stack([np.full(len(y), x0), y[::-1]])
    return np.concatenate([bottom[:-1], right[:-1], top[:-1], left[:-1]])


def _side(a: float, b: float) -> Float[np.ndarray, " s"]:
    """Points from a to b, with those among them where contraction begins."""
    return np.union1d(np.linspace(a, b, POINTS_PER_SIDE), [each for each in (-1.0, 1.0) if a < each < b])
