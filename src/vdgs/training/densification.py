"""Where anchors are added and removed: statistics, growing, pruning (Scaffold-GS section 4.2).

Dimensions: n anchors, k offsets, v anchors visible in a view, m Gaussians drawn (splats), p parents.
`DensificationStats` are kept per anchor and grow and shrink with them; all here are pure functions.
Plain growth and compensated growth (`vdgs.training.compensation`) are one policy: the latter adds to the gradients.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.config.method import DensifyConfig
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import FEATURE_SIZE, DensificationStats
from vdgs.model.anchors import Anchors

#: Cells have keys within this many cells of the origin on each axis.
LATTICE_REACH = 2**20
#: So many random numbers are drawn at once: the numbers are those of one long draw, the memory is not.
RANDOM_CHUNK = 2**20

#: Which places [p, 3] may get a new anchor, as a mask [p].
GrowthMask = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class CompensatedGradient:
    """What compensation changes in one decision (VDGS section IV-C); `compensation.compensate` makes it."""

    #: Added to the gradients: the cache g_k for offsets of low visibility (the set L), 0 for the others.
    added: Float[Tensor, "n k"]
    #: The anchors of L.
    low: Bool[Tensor, " n"]
    #: An offset of L with g_k > 0 is judged once it was drawn more often than this (never later than without).
    min_draws: float
    #: Added to the sum of an offset's gradients, before it is divided by how often it was drawn; else to their mean.
    to_sum: bool = False

    def per_draw(self, drawn: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """What a mean over so many draws gains; an offset that was never drawn counts as drawn once."""
        return self.added / drawn.clamp(min=1) if self.to_sum else self.added


@dataclass(frozen=True)
class DensificationDecision:
    """What one growth step does to the anchors: first append `added`, then keep `keep_mask` of the old ones."""

    added: Anchors
    keep_mask: Bool[Tensor, " n"]
    pruned: int
    #: New anchors in cells with at least one parent of low visibility, and the other new anchors.
    grown_low: int
    grown_other: int


@dataclass(frozen=True)
class Parents:
    """Offsets that ask for a new anchor: index into the flattened [n, k] (ascending), gradient, whether in L."""

    index: Int64[Tensor, " p"]
    gradient: Float[Tensor, " p"]
    low: Bool[Tensor, " p"]

    def __len__(self) -> int:
        return self.index.shape[0]

    def select(self, mask: Bool[Tensor, " p"]) -> Parents:
        return Parents(self.index[mask], self.gradient[mask], self.low[mask])


def mean_gradient(statistics: DensificationStats) -> Float[Tensor, "n k"]:
    """Mean gradient norm over the times that an offset was drawn; 0 where it never was."""
    times = statistics.drawn.clamp(min=1)
    return torch.div(statistics.gradient, times, out=times)


def decide_densification(
    anchors: Anchors,
    statistics: DensificationStats,
    voxel: float,
    config: DensifyConfig,
    generator: torch.Generator,
    *,
    compensated: CompensatedGradient | None = None,
    frozen: Anchors | None = None,
    growth_mask: GrowthMask | None = None,
    max_pixels: Sequence[float] = (),
) -> DensificationDecision:
    """One growth decision (Scaffold-GS eqs. 9-10 and its pruning; with `compensated`, VDGS section IV-C).

    `frozen` are further anchors that occupy cells; `growth_mask` says which cell centers may get an anchor;
    `max_pixels` are those of the levels, finest first (`model.levels`): each level grows in cells of its own, of twice
    the size of those of the finer one, for its own offsets and for those of the next coarser one that ask twice as
    strongly.
    Random numbers belong to offsets, not to policies: the same generator keeps the same offsets with compensation and
    without. With levels of anchors only up to where the first of these stops at another size of cells: it draws no
    numbers for the smaller ones, and the next level goes on from there.

    Resets, in place, the gradient statistics of the offsets that were judged and the opacity statistics of the
    anchors that were, as upstream does; the others keep counting.
    """
    judged = _judged(statistics, config, compensated)
    parents = _parents(statistics, judged, config.grad_threshold, compensated)
    added, grown_low = anchors.select(parents.index[:0]), 0
    for level in reversed(_levels(anchors, frozen, parents, voxel, max_pixels)):
        more, low = _grow(anchors, level, len(added), config, generator, growth_mask)
        added, grown_low = added.concat(more), grown_low + low
    statistics.gradient[judged] = 0
    statistics.drawn[judged] = 0

    old_enough = statistics.seen > config.prune_view_fraction * config.every
    faint = statistics.opacity < config.prune_opacity * statistics.seen
    pruned = old_enough & faint
    statistics.opacity[old_enough] = 0
    statistics.seen[old_enough] = 0
    return DensificationDecision(added, ~pruned, int(pruned.sum()), grown_low, len(added) - grown_low)


def _judged(
    statistics: DensificationStats, config: DensifyConfig, compensated: CompensatedGradient | None
) -> Bool[Tensor, "n k"]:
    """Offsets that were drawn often enough to be judged."""
    judged = statistics.drawn > config.min_draw_fraction * config.every
    if compensated is not None:
        judged |= (statistics.drawn > compensated.min_draws) & (compensated.added > 0)
    return judged


def _parents(
    statistics: DensificationStats,
    judged: Bool[Tensor, "n k"],
    threshold: float,
    compensated: CompensatedGradient | None,
) -> Parents:
    """The judged offsets whose mean gradient, compensated, reaches the threshold of the first level."""
    gradient = mean_gradient(statistics)
    if compensated is not None:
        gradient += compensated.per_draw(statistics.drawn)
    index = (judged & (gradient >= threshold)).reshape(-1).nonzero()[:, 0]
    low = torch.zeros_like(index, dtype=torch.bool)
    if compensated is not None:
        low = compensated.low[index // gradient.shape[1]]
    return Parents(index, gradient.reshape(-1)[index], low)


@dataclass(frozen=True, eq=False)
class _Level:
    """What one level of anchors grows from: parents, the places that are taken, and its voxel."""

    parents: Parents
    taken: Sequence[Float[Tensor, "_ 3"]]
    voxel: float
    max_pixel: float | None = None


def _levels(
    anchors: Anchors, frozen: Anchors | None, parents: Parents, voxel: float, max_pixels: Sequence[float]
) -> list[_Level]:
    """The levels of the anchors, finest first; one without levels."""
    there = [anchors] if frozen is None else [anchors, frozen]
    if anchors.max_pixels is None:
        return [_Level(parents, [each.positions for each in there], voxel)]
    own, levels = anchors.max_pixels[parents.index // anchors.offsets.shape[1]], []
    for level, largest in enumerate(max_pixels):
        coarser = own == (max_pixels[level + 1] if level + 1 < len(max_pixels) else -1.0)
        asking = Parents(parents.index, torch.where(coarser, 0.5 * parents.gradient, parents.gradient), parents.low)
        taken = [each.positions[each.max_pixels == largest] for each in there]
        levels.append(_Level(asking.select(coarser | (own == largest)), taken, voxel * 2.0**level, largest))
    return levels


def _grow(
    anchors: Anchors,
    level: _Level,
    added: int,
    config: DensifyConfig,
    generator: torch.Generator,
    growth_mask: GrowthMask | None,
) -> tuple[Anchors, int]:
    """New anchors of a level, at the centers of empty cells that hold a parent's Gaussian, and how many have a parent
    in L. So many were `added` before."""
    parents, grown, grown_low = level.parents, anchors.select(level.parents.index[:0]), 0
    for size in range(config.num_levels):
        parents = parents.select(parents.gradient >= config.grad_threshold * 2.0**size)
        room = config.max_anchors - len(anchors) - added - len(grown) if config.max_anchors else None
        if not len(parents) or (room is not None and room <= 0):
            break  # later levels ask for more
        count = anchors.offsets.shape[0] * anchors.offsets.shape[1]
        kept = parents.select(_random(parents.index, count, generator) > 0.5 ** (size + 1))
        cell = level.voxel * config.coarsest_voxels / 4.0**size
        more, low = fill_cells(anchors, kept, [*level.taken, grown.positions], cell, room, growth_mask)
        if level.max_pixel is not None:
            more = replace(more, max_pixels=torch.full_like(more.positions[:, 0], level.max_pixel))
        grown, grown_low = grown.concat(more), grown_low + low
    return grown, grown_low


def _random(index: Int64[Tensor, " p"], count: int, generator: torch.Generator) -> Float[Tensor, " p"]:
    """The numbers at `index` (ascending) of `count` uniform random numbers."""
    here = index.cpu()  # drawn on the CPU: the same numbers for any device
    numbers = torch.empty(len(index), dtype=torch.float32, device="cpu")
    done = 0
    for start in range(0, count, RANDOM_CHUNK):
        chunk = torch.rand(min(RANDOM_CHUNK, count - start), generator=generator, dtype=torch.float32, device="cpu")
        end = int(torch.searchsorted(here, start + len(chunk)))
        numbers[done:end] = chunk[here[done:end] - start]
        done = end
    return numbers.to(index.device)


def fill_cells(
    anchors: Anchors,
    parents: Parents,
    taken: Sequence[Float[Tensor, "_ 3"]],
    cell: float,
    max_new: int | None,
    growth_mask: GrowthMask | None,
) -> tuple[Anchors, int]:
    """An anchor at the center of each allowed cell that holds a parent's Gaussian and no anchor, at most `max_new` of
    the largest gradients; and how many of the cells have a parent in L."""
    kernels, k = get_backend(anchors.positions.device), anchors.offsets.shape[1]
    rows = parents.index // k
    means = anchors.positions[rows] + anchors.offsets[rows, parents.index % k] * anchors.log_scales[rows, :3].exp()
    within = _within_lattice(means, cell)
    parents, means = parents.select(within), means[within]
    # Cells are centered on multiples of their edge (upstream rounds), hence the origin at half a cell.
    origin = means.new_full((3,), -0.5 * cell)
    cells, group = kernels.group_cells(kernels.cell_keys(means, cell, origin))
    chosen = ~_hold_any(cells, taken, cell, origin)
    if growth_mask is not None:
        chosen[chosen.clone()] = growth_mask(kernels.cell_centers(cells[chosen], cell, origin))
    if max_new is not None and int(chosen.sum()) > max_new:
        strongest = kernels.group_max(parents.gradient[:, None], group, len(cells))[:, 0]
        strongest[~chosen] = -1.0
        best = strongest.argsort(descending=True, stable=True)[:max_new]
        chosen = torch.zeros_like(chosen).index_fill_(0, best, True)
    served = chosen[group]
    index = (chosen.cumsum(0) - 1)[group[served]]
    return _anchors_at(kernels.cell_centers(cells[chosen], cell, origin), index, parents.select(served), anchors, cell)


def _anchors_at(
    centers: Float[Tensor, "c 3"], place: Int64[Tensor, " p"], parents: Parents, anchors: Anchors, cell: float
) -> tuple[Anchors, int]:
    """New anchors at `centers`, the features the maximum of their parents', and how many have a parent in L."""
    kernels, k, count = get_backend(centers.device), anchors.offsets.shape[1], len(centers)
    new = Anchors(
        positions=centers,
        features=kernels.group_max(anchors.features[parents.index // k], place, count).reshape(count, FEATURE_SIZE),
        offsets=centers.new_zeros(count, k, 3),
        log_scales=centers.new_full((count, 6), math.log(cell)),
    )
    return new, len(place[parents.low].unique())


def _hold_any(
    cells: Int64[Tensor, " c"], points: Sequence[Float[Tensor, "_ 3"]], cell: float, origin: Float[Tensor, "3"]
) -> Bool[Tensor, " c"]:
    """Which of the cells hold any of the points."""
    kernels, full = get_backend(cells.device), torch.zeros_like(cells, dtype=torch.bool)
    for some in points:
        within = _within_lattice(some, cell)
        some = some if bool(within.all()) else some[within]
        full |= kernels.contains(kernels.cell_keys(some, cell, origin), cells)
    return full


def _within_lattice(points: Float[Tensor, "p 3"], cell: float) -> Bool[Tensor, " p"]:
    """Which points have a cell: finite and within 2^20 cells of the origin (21 bits an axis); others do not grow."""
    return (points.abs() < (LATTICE_REACH - 2) * cell).all(1)
