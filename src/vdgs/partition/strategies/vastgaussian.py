"""VastGaussian's partition: cells with equally many cameras, cameras by the area that a cell takes of their pictures.

Lin et al., VastGaussian: Vast 3D Gaussians for Large Scene Reconstruction, CVPR 2024, section 4.1.
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
from vdgs.partition.strategies.strategy import EXTENT_QUANTILES, checked_xy, grid_shape, nonempty_cells, scale_shape

#: Cells are widened to this many times their sides for training (section 4.1: by 20 %).
CELL_EXPANSION = 1.2
#: A camera joins where the cell covers this share of its picture (section 5: 25 %).
MIN_VISIBLE_SHARE = 0.25


@dataclass(frozen=True)
class VastGaussian:
    """Progressive partition without its point selection."""

    citation: str = "Lin et al., VastGaussian, CVPR 2024"
    omissions: tuple[str, ...] = (
        "coverage-based point selection: a block starts from the coarse anchors, and the rest is frozen context",
        "decoupled appearance modelling",
    )

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        """Sections with equally many cameras along the longer side, each cut again across it."""
        ground = checked_xy(positions)
        centers = np.array([camera.position[:2] for camera in cameras], np.float64)
        low = np.minimum(np.quantile(ground, EXTENT_QUANTILES[0], axis=0), centers.min(axis=0))
        high = np.maximum(np.quantile(ground, EXTENT_QUANTILES[1], axis=0), centers.max(axis=0))
        margin = 1e-6 * float((high - low).max()) + 1e-9
        low, high = low - margin, high + margin
        spread = np.ptp(centers, axis=0) + margin
        columns, rows = grid_shape(count, spread[0] / spread[1])
        cells = []
        for x0, x1, section in _equal_camera_splits(centers, 0, columns, low[0], high[0]):
            for y0, y1, _ in _equal_camera_splits(section, 1, rows, low[1], high[1]):
                if x1 > x0 and y1 > y0:
                    core = shapely.box(x0, y0, x1, y1)
                    cells.append(Block(core, scale_shape(core, CELL_EXPANSION)))
        return nonempty_cells(cells, ground, count)

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        return replace(config, mode="frustum", threshold=MIN_VISIBLE_SHARE)

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        """The share of the picture that the cell's box covers; a camera in the widened cell always joins."""
        boxes = [_corners(block.core, positions[blocks.owner(checked_xy(positions)) == index, 2])
                 for index, block in enumerate(blocks.items)]  # fmt: skip
        shares = np.array([[box_coverage(box, camera) for box in boxes] for camera in cameras])
        centers = np.array([camera.position[:2] for camera in cameras], np.float64)
        inside = [shapely.contains_xy(block.expanded, centers[:, 0], centers[:, 1]) for block in blocks.items]
        joined = np.where(np.stack(inside, axis=1), 1.0, shares)
        return replace(scores, scores=joined.astype(scores.scores.dtype))


def box_coverage(corners: Float[np.ndarray, "8 3"], camera: Camera) -> float:
    """Share of the picture within the convex hull of a projected box; only what lies before the camera counts.

    The box is cut at a near plane, so that one which reaches behind the camera is projected rightly.
    """
    local = corners @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    near = 1e-3 * max(float(np.abs(local).max()), 1e-9)
    before = [point for point in local if point[2] >= near]
    for i in range(8):
        for bit in (1, 2, 4):
            a, b = local[i], local[i ^ bit]
            if a[2] < near <= b[2]:
                before.append(a + (near - a[2]) / (b[2] - a[2]) * (b - a))
    if len(before) < 3:
        return 0.0
    points = np.array(before)
    x = camera.fx * points[:, 0] / points[:, 2] + camera.cx
    y = camera.fy * points[:, 1] / points[:, 2] + camera.cy
    hull = shapely.MultiPoint(np.column_stack([x, y])).convex_hull
    picture = shapely.box(0, 0, camera.width, camera.height)
    return float(hull.intersection(picture).area / picture.area)


def _corners(core: shapely.Polygon, heights: Float[np.ndarray, " n"]) -> Float[np.ndarray, "8 3"]:
    """The box over a cell, from its lowest to its highest anchor; corner i ^ 1, 2, 4 is the neighbour in x, y, z."""
    x0, y0, x1, y1 = core.bounds
    z0, z1 = np.quantile(heights, EXTENT_QUANTILES)
    return np.array([[x0 if i & 1 else x1, y0 if i & 2 else y1, z0 if i & 4 else z1] for i in range(8)])


def _equal_camera_splits(
    centers: Float[np.ndarray, "c 2"], axis: int, parts: int, low: float, high: float
) -> list[tuple[float, float, Float[np.ndarray, "m 2"]]]:
    """From, to and cameras of each part along an axis; parts meet halfway between neighbouring cameras."""
    if len(centers) == 0:
        return [(low, high, centers)]
    ordered = centers[np.argsort(centers[:, axis], kind="stable")]
    sections = np.array_split(ordered, min(parts, len(ordered)))
    meets = [(a[-1, axis] + b[0, axis]) / 2 for a, b in itertools.pairwise(sections)]
    edges = [low, *meets, high]
    return [(edges[i], edges[i + 1], section) for i, section in enumerate(sections)]
