"""DOGS's partition: the scene's oriented box cut into equal cells, each widened by 1.4.

Chen and Lee, DOGS: Distributed-Oriented Gaussian Splatting for Large-Scale 3D Reconstruction via Gaussian Consensus,
NeurIPS 2024.
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
from vdgs.partition.principal_axes import fit_principal_plane
from vdgs.partition.strategies.strategy import EXTENT_QUANTILES, checked_xy, grid_shape, nonempty_cells, scale_shape

#: A cell is trained this many times as large.
CELL_EXPANSION = 1.4
#: A camera joins that holds this share of a cell's anchors (choice).
MIN_ANCHOR_SHARE = 0.25


@dataclass(frozen=True)
class Dogs:
    """Equal oriented cells without the consensus of the blocks."""

    citation: str = "Chen and Lee, DOGS, NeurIPS 2024"
    omissions: tuple[str, ...] = (
        "the consensus (ADMM) on what blocks share: each block's own cell is kept, its ring is frozen",
        "splitting by content: cells are equal; cameras join by the share of the cell's anchors that they hold",
    )

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        ground = checked_xy(positions)
        plane = fit_principal_plane(ground)
        places = plane.to_plane(ground)
        low, high = np.quantile(places, EXTENT_QUANTILES, axis=0)
        size = np.maximum(high - low, 1e-6 * float(np.abs(places).max()) + 1e-9)
        columns, rows = grid_shape(count, float(size[0] / size[1]))
        across, up = (low[i] + size[i] * np.linspace(0, 1, n + 1) for i, n in enumerate((columns, rows)))
        cores = [
            plane.to_ground(shapely.box(x0, y0, x1, y1))
            for x0, x1 in itertools.pairwise(across)
            for y0, y1 in itertools.pairwise(up)
        ]
        return nonempty_cells([Block(core, scale_shape(core, CELL_EXPANSION)) for core in cores], ground, count)

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        return replace(config, mode="frustum", threshold=MIN_ANCHOR_SHARE)

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        return scores
