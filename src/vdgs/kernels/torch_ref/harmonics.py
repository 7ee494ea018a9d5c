"""Spherical harmonics of many Gaussians: the colors that they show, and their fit to colors that cameras saw.

The fit is a weighted ridge regression of each Gaussian, in closed form: minimize over c
Σ_v w_v |Y(d_v) c - (color_v - 1/2)|² / Σ_v w_v + ridge |c'|², where c' are the coefficients but the constant one.
Dimensions: n Gaussians, m of them; p pairs of a Gaussian and a camera, sorted by Gaussian; f = (degree + 1)² functions.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.spherical_harmonics import eval_sh_bases, eval_sh_colors, num_sh_bases

#: So many regressions are solved together, of about as many pairs each: their matrices stay in the cache.
BATCH_GAUSSIANS = 2048
#: Pairs of those at most, unless one alone has more.
BATCH_PAIRS = 1 << 16


def harmonic_colors(
    means: Float[Tensor, "m 3"], coefficients: Float[Tensor, "n c"], rows: Int64[Tensor, " m"],
    eye: Float[Tensor, "3"], degree: int,
) -> Float[Tensor, "m 3"]:  # fmt: skip
    """RGB that the Gaussians of some `rows`, which lie at `means`, show to an `eye`: 1/2 + Σ c Y, not below 0.

    `coefficients` are those of all Gaussians, c = 3 f: RGB of the constant function first; their rows may stand apart.
    Raises ValueError for another c or shapes that do not match, IndexError where a row is none of theirs.
    """
    check_coefficients(coefficients, rows, degree)
    check_row_shapes(len(rows), means=(means, 3))
    check_row_shapes(3, eye=(eye,))
    chosen = coefficients[rows].unflatten(1, (-1, 3))
    directions = torch.nn.functional.normalize(means - eye, dim=1)
    return eval_sh_colors(chosen[:, 0], chosen[:, 1:], directions, degree)


def fit_harmonics(
    directions: Float[Tensor, "p 3"], colors: Float[Tensor, "p 3"], weights: Float[Tensor, " p"],
    starts: Int64[Tensor, " m"], degree: int, ridge: float,
) -> Float[Tensor, "m f 3"]:  # fmt: skip
    """Coefficients of each Gaussian, whose pairs begin at `starts`. Directions are unit, from the camera; weights are
    not negative. Raises ValueError unless each has a pair and the first begins with the first pair, and for shapes that
    do not match."""
    check_starts(starts, len(weights))
    check_row_shapes(len(weights), directions=(directions, 3), colors=(colors, 3), weights=(weights,))
    functions = eval_sh_bases(directions, degree)
    f = functions.shape[1]
    known = torch.cat([functions, colors - 0.5], 1)
    pull = functions.new_full((f,), ridge, dtype=torch.float64)
    pull[0] = 0.0
    found = functions.new_empty(len(starts), f, 3)
    for rows, places, there in _alike(starts, len(weights)):
        share = torch.where(there, weights[places], 0.0).double()
        share /= share.sum(1, keepdim=True)
        padded = known[places].double()
        products = torch.bmm((padded[..., :f] * share[..., None]).transpose(1, 2), padded)
        matrix, right = products[..., :f] + torch.diag(pull), products[..., f:]
        found[rows] = torch.cholesky_solve(right, torch.linalg.cholesky(matrix)).float()
    return found


def _alike(
    starts: Int64[Tensor, " m"], pairs: int
) -> Iterator[tuple[Int64[Tensor, " b"], Int64[Tensor, "b v"], Bool[Tensor, "b v"]]]:
    """Gaussians with about as many pairs each: their rows, the places of their pairs, and which of those are theirs."""
    counts = torch.diff(starts, append=starts.new_tensor([pairs]))
    order = torch.argsort(counts, descending=True, stable=True)
    first = 0
    while first < len(order):
        most = int(counts[order[first]])
        rows = order[first : first + max(1, min(BATCH_GAUSSIANS, BATCH_PAIRS // most))]
        inside = torch.arange(most, device=starts.device)
        places = starts[rows, None] + inside
        yield rows, places.clamp(max=pairs - 1), inside < counts[rows, None]
        first += len(rows)


def check_coefficients(coefficients: Tensor, rows: Tensor, degree: int) -> None:
    """Raise ValueError unless they are of this degree, IndexError unless all rows are among them."""
    if coefficients.shape[1] != 3 * num_sh_bases(degree):
        raise ValueError(f"degree {degree} has {3 * num_sh_bases(degree)} coefficients, not {coefficients.shape[1]}")
    if len(rows) and not (int(rows.min()) >= 0 and int(rows.max()) < len(coefficients)):
        raise IndexError(f"a row lies outside the {len(coefficients)} Gaussians")


def check_starts(starts: Tensor, pairs: int) -> None:
    """Raise ValueError unless pairs are cut into runs, each of at least one."""
    if not len(starts):
        if pairs:
            raise ValueError("there are pairs of no Gaussian")
        return
    apart = torch.diff(starts, append=starts.new_tensor([pairs]))
    if int(starts[0]) != 0 or int(apart.min()) < 1:
        raise ValueError("every Gaussian needs a pair of its own, and the first begins with the first pair")
