"""Where anchors are added and removed: statistics, growing, pruning (Scaffold-GS section 4.2).

Dimensions: n anchors, k offsets, v anchors visible in a view, m Gaussians drawn (splats).
`Statistics` are kept per anchor and grow and shrink with them; the rest are pure functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.anchors import Anchors
from vdgs.config import GrowthConfig
from vdgs.kernels import native as kernels
from vdgs.kernels.decode_types import FEATURE_SIZE

#: Cells have keys within this many cells of the origin on each axis.
LATTICE_REACH = 2**20


@dataclass
class Statistics:
    """Sums over the views since the last decision (float32; counts are exact up to 2^24)."""

    #: Norm of dL/d(mean) in NDC units, and how often the offset was drawn, [n, k].
    gradient: Float[Tensor, "n k"]
    drawn: Float[Tensor, "n k"]
    #: Opacity of the anchor's Gaussians, summed over them, and how often the anchor was visible, [n].
    opacity: Float[Tensor, " n"]
    seen: Float[Tensor, " n"]

    @staticmethod
    def zeros(n: int, k: int) -> Statistics:
        return Statistics(torch.zeros(n, k), torch.zeros(n, k), torch.zeros(n), torch.zeros(n))

    def tensors(self) -> dict[str, Tensor]:
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def select(self, rows: Tensor) -> Statistics:
        return Statistics(**{name: tensor[rows] for name, tensor in self.tensors().items()})

    def extended(self, count: int) -> Statistics:
        """The same, followed by `count` anchors without history."""
        return Statistics(
            **{name: torch.cat([t, t.new_zeros(count, *t.shape[1:])]) for name, t in self.tensors().items()}
        )

    def add_view(
        self,
        visible: Int64[Tensor, " v"],
        source: Tensor,
        opacities: Float[Tensor, " m"],
        gradient_px: Float[Tensor, "m 2"],
        width: int,
        height: int,
    ) -> None:
        """Count one view; see `kernels.add_view_statistics`."""
        kernels.add_view_statistics(visible, source, opacities, gradient_px, width, height, *self.tensors().values())


@dataclass(frozen=True)
class Decision:
    """What one growth step does to the anchors: first append `added`, then keep `kept` of all."""

    added: Anchors
    kept: Bool[Tensor, " n"]
    pruned: int


def mean_gradient(statistics: Statistics) -> Float[Tensor, "n k"]:
    """Mean gradient norm over the times that an offset was drawn; 0 where it never was."""
    return statistics.gradient / statistics.drawn.clamp(min=1)


def decide(
    anchors: Anchors,
    statistics: Statistics,
    voxel: float,
    config: GrowthConfig,
    generator: torch.Generator,
) -> Decision:
    """One growth decision (Scaffold-GS eqs. 9-10 and its pruning).

    Resets, in place, the gradient statistics of the offsets that were judged and the opacity statistics of the
    anchors that were, as upstream does; the others keep counting.
    """
    judged = statistics.drawn > config.gate * config.interval
    added = _grow(anchors, mean_gradient(statistics), judged, voxel, config, generator)
    statistics.gradient[judged] = 0
    statistics.drawn[judged] = 0

    old_enough = statistics.seen > config.prune_views * config.interval
    faint = statistics.opacity < config.prune_opacity * statistics.seen
    pruned = old_enough & faint
    statistics.opacity[old_enough] = 0
    statistics.seen[old_enough] = 0
    return Decision(added, ~pruned, int(pruned.sum()))


def _grow(
    anchors: Anchors,
    gradient: Float[Tensor, "n k"],
    judged: Bool[Tensor, "n k"],
    voxel: float,
    config: GrowthConfig,
    generator: torch.Generator,
) -> Anchors:
    """New anchors, at the centres of empty cells that hold an offset with a large gradient."""
    grown = anchors.select(torch.zeros(0, dtype=torch.int64))
    for level in range(config.levels):
        threshold = config.threshold * 2.0**level
        cell = voxel * config.coarsest_cell / 4.0**level
        keep = torch.rand(gradient.shape, generator=generator) > 0.5 ** (level + 1)
        parents = (judged & (gradient >= threshold) & keep).reshape(-1).nonzero()[:, 0]
        room = config.max_anchors - len(anchors) - len(grown) if config.max_anchors else None
        if len(parents) and (room is None or room > 0):
            occupied = torch.cat([anchors.positions, grown.positions])
            grown = grown.extended(_fill_cells(anchors, gradient, parents, occupied, cell, room))
    return grown


def _fill_cells(
    anchors: Anchors,
    gradient: Float[Tensor, "n k"],
    parents: Int64[Tensor, " p"],
    occupied: Float[Tensor, "a 3"],
    cell: float,
    room: int | None,
) -> Anchors:
    """One anchor at the centre of each cell that holds a parent's Gaussian and no anchor yet.

    Where `room` is short, the cells with the largest gradients are served first.
    """
    k = anchors.offsets.shape[1]
    rows, offset = parents // k, parents % k
    means = anchors.positions[rows] + anchors.offsets[rows, offset] * anchors.log_scales[rows, :3].exp()
    within = _within_lattice(means, cell)
    parents, rows, means = parents[within], rows[within], means[within]
    if not len(parents):
        return anchors.select(parents)
    # Cells are centred on multiples of their edge (upstream rounds), hence the origin at half a cell.
    origin = torch.full((3,), -0.5 * cell)
    keys = kernels.cell_keys(means, cell, origin)
    cells, group = kernels.group_cells(keys)
    empty = ~kernels.contains(kernels.cell_keys(occupied[_within_lattice(occupied, cell)], cell, origin), cells)
    features = kernels.group_max(anchors.features[rows], group, len(cells))
    if room is not None and int(empty.sum()) > room:
        strongest = kernels.group_max(gradient.reshape(-1)[parents][:, None], group, len(cells))[:, 0]
        strongest[~empty] = -1.0
        empty = torch.zeros_like(empty).index_fill_(0, strongest.argsort(descending=True, stable=True)[:room], True)
    centres = kernels.cell_centres(cells[empty], cell, origin)
    count = len(centres)
    return Anchors(
        positions=centres,
        features=features[empty].reshape(count, FEATURE_SIZE),
        offsets=torch.zeros(count, k, 3),
        log_scales=torch.full((count, 6), math.log(cell)),
    )


def _within_lattice(points: Float[Tensor, "p 3"], cell: float) -> Bool[Tensor, " p"]:
    """Which points have a cell: finite and within 2^20 cells of the origin (a key has 21 bits an axis).

    What lies farther away than a million of the finest cells does not grow (choice)."""
    return (points.abs() < (LATTICE_REACH - 2) * cell).all(1)
