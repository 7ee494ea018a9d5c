"""Coarser levels of a scene: Gaussians merged where they are closer together than the level shows.

Each cell of a grid becomes one Gaussian with the mean, spread and color of those in it, weighted by what they cover.
Two things differ from the moments alone, so that a surface stays closed. The spread of the centers within a cell counts
`SPREAD_FACTOR` times: neighbors that only share an edge would leave gaps between them. And optical depth times area is
kept, not opacity: many small opaque Gaussians make one large opaque one, few make a faint one.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.model.gaussian_transform import gaussian_covariances
from vdgs.model.gaussians import Gaussians

#: Centers spread evenly over a cell of edge e have the variance e² / 12 along each axis; four times that is a standard
#: deviation of 0.58 e: neighbors on a grid then overlap to an alpha of 0.9 and more everywhere between them.
SPREAD_FACTOR = 4.0
#: Opacities of merged Gaussians end here, as those that are drawn do.
MAX_OPACITY = 0.999
#: By how much a cell grows while there are still too many of them.
CELL_GROWTH = 1.2
#: So much of what may be left is left, at least (choice).
MIN_FILL = 0.8
#: Cells are made smaller so often at most, which is far more than a scene needs: where many Gaussians have one place,
#: no cells part them.
MAX_TRIES = 16


def simplify(gaussians: Gaussians, max_count: int) -> tuple[Gaussians, float]:
    """At most `most` Gaussians that look like these from afar, and the edge of the cells that they were merged in.

    At least `MIN_FILL` of `most` are left, unless so many have one place that no cells come near. The edge is 0 where
    nothing had to be merged.
    """
    if len(gaussians) <= max_count:
        return gaussians, 0.0
    means = gaussians.means.double()
    size = (means.amax(0) - means.amin(0)).clamp_min(1e-9)
    # The first guess: the cells that a surface as large as the two longest sides would fill.
    edge, too_small = math.sqrt(float(size.topk(2).values.prod()) / max_count), 0.0
    cells = cell_indices(means, edge)
    while _cell_count(cells) > max_count:
        edge, too_small = edge * CELL_GROWTH, edge
        cells = cell_indices(means, edge)
    # A few things far from all others make the sides long, and the cells too large for everything else.
    edge, cells = _smaller(means, max_count, edge, cells, too_small)
    return merge_cells(gaussians, cells), edge


def _smaller(
    means: Float[Tensor, "n 3"], max_count: int, edge: float, cells: Int64[Tensor, " n"], too_small: float
) -> tuple[float, Int64[Tensor, " n"]]:
    """The edge and the cells, made smaller until `MIN_FILL` of `most` are in use. `too_small`: an edge that makes more
    than `most`; 0 where none is known."""
    for _ in range(MAX_TRIES):
        if (count := _cell_count(cells)) >= MIN_FILL * max_count:
            break
        # Half the edge, four times the cells: so it is on a surface. What falls beyond the bounds is halved between
        # them.
        tried = edge * math.sqrt(count / (max_count * (1 + MIN_FILL) / 2))
        if tried <= too_small:
            tried = math.sqrt(edge * too_small)
        found = cell_indices(means, tried)
        if _cell_count(found) > max_count:
            too_small = tried
        else:
            edge, cells = tried, found
    return edge, cells


def _cell_count(cells: Int64[Tensor, " n"]) -> int:
    """How many cells are in use."""
    return int(cells.max()) + 1


def cell_indices(means: Float[Tensor, "n 3"], edge: float) -> Int64[Tensor, " n"]:
    """The number of the cell of a cubic grid that each center lies in, 0 .. the number of cells in use - 1."""
    places = ((means - means.amin(0)) / edge).floor()
    if float((places.amax(0) + 1).prod()) >= 2.0**62:
        # Small cells about something very far: 64 bits number the layers in use, but not all of the grid.
        x, y, z = (torch.unique(column, return_inverse=True)[1] for column in places.unbind(1))
        x = torch.unique(x * _cell_count(y) + y, return_inverse=True)[1]
        return torch.unique(x * _cell_count(z) + z, return_inverse=True)[1]
    places = places.long()
    counts = places.amax(0) + 1
    keys = (places[:, 0] * counts[1] + places[:, 1]) * counts[2] + places[:, 2]
    return torch.unique(keys, return_inverse=True)[1]


def merge_cells(gaussians: Gaussians, cells: Int64[Tensor, " n"]) -> Gaussians:
    """One Gaussian for each cell, in the order of their numbers."""
    count = _cell_count(cells)
    areas = _areas(gaussians.log_scales)
    depth = -torch.log1p(-gaussians.opacity_logits.sigmoid().double().clamp_max(MAX_OPACITY))
    cover = depth * areas
    weights = cover.clamp_min(1e-30)

    def pooled(values: Tensor) -> Tensor:
        """Weighted means over each cell."""
        flat = values.double().reshape(len(values), -1)
        sums = torch.zeros(count, flat.shape[1], dtype=torch.float64).index_add_(0, cells, flat * weights[:, None])
        return (sums / totals[:, None]).reshape(count, *values.shape[1:])

    totals = torch.zeros(count, dtype=torch.float64).index_add_(0, cells, weights)
    means = pooled(gaussians.means)
    apart = gaussians.means.double() - means[cells]
    spread = pooled(gaussian_covariances(gaussians).double() + SPREAD_FACTOR * apart[:, :, None] * apart[:, None, :])
    log_scales, quaternions = ellipsoid_axes(spread)
    cover_of_cell = torch.zeros(count, dtype=torch.float64).index_add_(0, cells, cover)
    opacity = -torch.expm1(-cover_of_cell / _areas(log_scales))
    together = Gaussians(
        means=means.float(), log_scales=log_scales.float(), quaternions=quaternions.float(),
        opacity_logits=torch.logit(opacity.clamp(1e-6, MAX_OPACITY)).float(), sh0=pooled(gaussians.sh0).float(),
        shN=pooled(gaussians.shN).float(),
    )  # fmt: skip
    # What is alone in its cell stays as it is.
    alone = torch.bincount(cells, minlength=count) == 1
    first = torch.zeros(count, dtype=torch.int64).index_copy_(0, cells, torch.arange(len(cells)))
    kept = gaussians.select(first)
    pick = {
        name: torch.where(alone.reshape(-1, *[1] * (tensor.dim() - 1)), kept.tensors()[name], tensor)
        for name, tensor in together.tensors().items()
    }
    return Gaussians(**pick)


def _areas(log_scales: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Product of the two largest standard deviations: what a Gaussian covers, seen from its broad side."""
    return log_scales.double().topk(2, dim=-1).values.sum(-1).exp()


def ellipsoid_axes(spread: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Logarithms of the standard deviations and rotations (wxyz) of covariances."""
    variances, axes = torch.linalg.eigh(spread)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    least = variances[:, -1:].clamp_min(1e-18) * 1e-8
    return variances.clamp_min(least).log() / 2, _quaternions(axes)


def _quaternions(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions, wxyz, of rotation matrices, by the largest of the four (Shepperd, 1978)."""
    m = rotations.numpy()
    trace = np.trace(m, axis1=1, axis2=2)
    squares = np.stack([1 + trace, *(1 + 2 * m[:, i, i] - trace for i in range(3))], 1)
    largest = squares.argmax(1)
    parts = np.empty((len(m), 4, 4))
    parts[:, range(4), range(4)] = squares
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0)), 1):
        parts[:, 0, k] = parts[:, k, 0] = m[:, i, j] - m[:, j, i]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        parts[:, a + 1, b + 1] = parts[:, b + 1, a + 1] = m[:, a, b] + m[:, b, a]
    chosen = parts[np.arange(len(m)), largest]
    return torch.from_numpy(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))
