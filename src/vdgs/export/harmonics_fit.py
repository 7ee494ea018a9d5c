"""Spherical harmonics fitted to the colours that cameras saw: weighted ridge regressions, many at once, in closed form.

Of each Gaussian: minimise over c  Σ_v w_v |Y(d_v) c - (colour_v - 1/2)|² / Σ_v w_v + RIDGE |c'|²,
where c' are the coefficients but the constant one. Dimensions: p pairs of a Gaussian and a camera, sorted by Gaussian;
m Gaussians; f = (degree + 1)² functions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vdgs.model.spherical_harmonics import basis

#: Pull of the coefficients towards one colour for all directions (choice): where cameras look from few directions, the
#: others must not swing. Chosen on validation views (docs/export.md).
RIDGE = 1e-3
#: So many regressions are solved together, of about as many pairs each: their matrices stay in the cache.
TOGETHER = 2048
#: Pairs of those at most, unless one alone has more.
PAIRS_TOGETHER = 1 << 16


def segment_sums(values: Float[np.ndarray, " p"], starts: Int[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Sums of runs of consecutive values, by where each begins; none is empty."""
    return np.add.reduceat(values, starts)


def fit_harmonics(
    directions: Float[Tensor, "p 3"],
    colours: Float[Tensor, "p 3"],
    weights: Float[Tensor, " p"],
    starts: Int[np.ndarray, " m"],
    degree: int,
) -> Float[Tensor, "m f 3"]:
    """Coefficients of each Gaussian, whose pairs begin at `starts`. Directions are unit, from the camera."""
    functions = basis(directions, degree)
    f = functions.shape[1]
    known = torch.cat([functions, colours - 0.5], 1)
    ridge = torch.full((f,), RIDGE, dtype=torch.float64)
    ridge[0] = 0.0
    found = torch.empty(len(starts), f, 3)
    for rows, places, there in _alike(starts, len(weights)):
        share = torch.where(there, weights[places], 0.0).double()
        share /= share.sum(1, keepdim=True)
        padded = known[places].double()
        products = torch.bmm((padded[..., :f] * share[..., None]).transpose(1, 2), padded)
        matrix, right = products[..., :f] + torch.diag(ridge), products[..., f:]
        found[rows] = torch.cholesky_solve(right, torch.linalg.cholesky(matrix)).float()
    return found


def _alike(starts: Int[np.ndarray, " m"], pairs: int) -> Iterator[tuple[Int[Tensor, " b"], Int[Tensor, "b v"], Tensor]]:
    """Gaussians with about as many pairs each: their rows, the places of their pairs, and which of those are theirs."""
    counts = np.diff(starts, append=pairs)
    order = np.argsort(-counts, kind="stable")
    first = 0
    while first < len(order):
        most = int(counts[order[first]])
        rows = order[first : first + max(1, min(TOGETHER, PAIRS_TOGETHER // most))]
        inside = np.arange(most)
        places = starts[rows, None] + inside
        there = inside < counts[rows, None]
        yield torch.from_numpy(rows), torch.from_numpy(np.minimum(places, pairs - 1)), torch.from_numpy(there)
        first += len(rows)
