"""How seldom a place is seen, from 0 to 1: what steers the terms of training that are meant for such places (choice).

A place with V training cameras has the share max(0, 1 - V / V*). V* is a quantile of V over the places where anchors
start: one number for the coarse stage and all blocks. What is seen at least as often as that is left alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.model.frustum import project
from vdgs.model.visibility import visibility_of

#: Cells along the longer side of a picture in which places are looked up (choice).
CELLS = 32


@dataclass(frozen=True, eq=False)
class Seldom:
    """Shares by the training cameras of a whole capture and the places where its anchors start (those that no camera
    holds do not count)."""

    cameras: Sequence[Camera]
    starts: Float[Tensor, "g 3"]
    #: The quantile of V over `starts` that is V*.
    quantile: float

    @cached_property
    def limit(self) -> float:
        """V*; 0 where no start is seen."""
        seen = visibility_of(self.starts, self.cameras)
        counts = seen[seen > 0].cpu().numpy()
        return float(np.quantile(counts, self.quantile)) if len(counts) else 0.0

    def share(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """How seldom places are seen. O(n · cameras)."""
        views = visibility_of(positions, self.cameras).float()
        return (1 - views / self.limit).clamp(min=0) if self.limit > 0 else torch.zeros_like(views)

    @cached_property
    def _of_starts(self) -> Float[Tensor, " g"]:
        return self.share(self.starts)

    def cells(self, camera: Camera) -> Float[Tensor, "rows columns"]:
        """The mean share of the starts in each cell of a picture, whatever hides them; where there is none, that of the
        nearest cell with some (0 without any)."""
        longer = max(camera.width, camera.height)
        columns, rows = (max(1, round(CELLS * side / longer)) for side in (camera.width, camera.height))
        seen = project(self.starts, camera)
        column = (seen.column[seen.inside] * (columns / camera.width)).long().clamp(max=columns - 1)
        row = (seen.row[seen.inside] * (rows / camera.height)).long().clamp(max=rows - 1)
        cell = row * columns + column
        held = cell.bincount(minlength=rows * columns)
        total = cell.bincount(weights=self._of_starts[seen.inside].double(), minlength=rows * columns)
        mean = (total / held.clamp(min=1)).float().reshape(rows, columns)
        if not bool(held.any()):
            return mean
        empty = (held == 0).reshape(rows, columns).cpu().numpy()
        nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
        return mean[tuple(torch.from_numpy(axis).long().to(mean.device) for axis in nearest)]
