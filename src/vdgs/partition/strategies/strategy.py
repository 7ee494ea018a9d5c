"""What a partition to compare with must say, and the parts that several of them share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import shapely
import shapely.affinity
from jaxtyping import Float

from vdgs.config.method import AssignmentConfig
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.blocks import Block, Blocks

#: Outliers beyond these quantiles of the anchors do not decide how large the scene is.
EXTENT_QUANTILES = (0.01, 0.99)


class PartitionStrategy(Protocol):
    """A published partition. Blocks own every place, by core or nearest core, as ours do."""

    @property
    def citation(self) -> str: ...

    @property
    def omissions(self) -> tuple[str, ...]: ...

    def partition(
        self, positions: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int
    ) -> tuple[Blocks, list[str]]:
        """At most `count` blocks from anchors and training cameras, and warnings for people."""
        ...

    def assignment(self, config: AssignmentConfig) -> AssignmentConfig:
        """How cameras are scored and above which score they join; topping up stays as it is."""
        ...

    def adjust_scores(
        self, scores: ScoreMatrix, positions: Float[np.ndarray, "n 3"], blocks: Blocks, cameras: Sequence[Camera]
    ) -> ScoreMatrix:
        """The scores with what the method adds to, or takes instead of, those of `assignment`."""
        ...


def grid_shape(count: int, aspect: float) -> tuple[int, int]:
    """Columns and rows with exactly `count` cells, the most nearly square where x is `aspect` times as long as y."""
    shapes = [(columns, count // columns) for columns in range(1, count + 1) if count % columns == 0]
    return min(shapes, key=lambda shape: abs(np.log(shape[0] / shape[1]) - np.log(max(aspect, 1e-9))))


def checked_xy(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """x, y in float64. Raises VdgsError if there is nothing to cut."""
    ground = np.asarray(positions, np.float64)[:, :2]
    if len(ground) == 0 or not np.isfinite(ground).all():
        raise VdgsError("the coarse model holds no anchors, or some at places that are no numbers. Train it again.")
    return ground


def nonempty_cells(cells: Sequence[Block], ground: Float[np.ndarray, "n 2"], count: int) -> tuple[Blocks, list[str]]:
    """The cells that own anchors, as blocks numbered along x."""
    owned = np.bincount(Blocks(tuple(cells)).owner(ground), minlength=len(cells))
    kept = [cell for cell, anchors in zip(cells, owned, strict=True) if anchors > 0]
    kept.sort(key=lambda cell: (cell.core.centroid.x, cell.core.centroid.y))
    warnings = []
    if len(kept) < count:
        warnings.append(f"the scene is cut into {len(kept)} blocks instead of {count}: the other cells hold no anchors")
    return Blocks(tuple(kept)), warnings


def scale_shape(shape: shapely.Polygon, factor: float) -> shapely.Polygon:
    """The shape `factor` times as large about its centre."""
    return shapely.affinity.scale(shape, factor, factor, origin="center")
