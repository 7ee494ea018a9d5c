"""The mean of ellipsoids by the logarithms of their covariances (Arsigny, Fillard, Pennec and Ayache, "Log-Euclidean
metrics for fast and simple calculus on diffusion tensors", 2006).

Half the logarithm of R diag(s²) Rᵀ is R diag(ln s) Rᵀ, which does not depend on order and signs of the axes, and whose
trace is the logarithm of the volume. Dimensions: p ellipsoids, m means.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.rotations import rotation_matrices
from vdgs.kernels.torch_ref.harmonics import check_starts

#: The six numbers of a symmetric matrix.
UPPER_TRIANGLE = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Rounds of Jacobi's method: each squares what is left beside the diagonal, at the end.
JACOBI_SWEEPS = 5


def mean_ellipsoids(
    log_scales: Float[Tensor, "p 3"], quaternions: Float[Tensor, "p 4"], weights: Float[Tensor, " p"],
    starts: Int64[Tensor, " m"],
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 4"]]:  # fmt: skip
    """Logarithms of the scales and unit quaternions, wxyz, of the mean of each Gaussian, whose pairs begin at `starts`.
    The axes come in any order. Weights are positive. Raises ValueError unless each has a pair and the first begins with
    the first pair, and for shapes that do not match."""
    check_starts(starts, len(weights))
    check_row_shapes(len(weights), log_scales=(log_scales, 3), quaternions=(quaternions, 4), weights=(weights,))
    if not len(starts):
        return log_scales.new_empty(0, 3), quaternions.new_empty(0, 4)
    counts = torch.diff(starts, append=starts.new_tensor([len(weights)]))
    gaussian = torch.arange(len(starts), device=starts.device).repeat_interleave(counts)
    shares = weights.double()[:, None]
    sums = shares.new_zeros(len(starts), 7)
    sums.index_add_(0, gaussian, torch.cat([shares * log_covariances(log_scales, quaternions), shares], 1))
    return from_log_covariances(sums[:, :6] / sums[:, 6:])


def log_covariances(log_scales: Float[Tensor, "p 3"], quaternions: Float[Tensor, "p 4"]) -> Float[Tensor, "p 6"]:
    """R diag(ln s) Rᵀ, as in `UPPER_TRIANGLE`."""
    axes = rotation_matrices(quaternions)
    scaled = axes * log_scales[:, None]
    return torch.stack([(scaled[:, i] * axes[:, j]).sum(1) for i, j in UPPER_TRIANGLE], 1)


def from_log_covariances(logarithm: Float[Tensor, "m 6"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 4"]]:
    """The inverse: logarithms of the scales and unit quaternions, wxyz. The axes come in any order.

    Jacobi's method (Golub and Van Loan, Matrix Computations, 8.5), of all matrices at once.
    """
    columns = logarithm.double().unbind(1)
    a = logarithm.new_empty(3, 3, len(logarithm), dtype=torch.float64)
    for (i, j), column in zip(UPPER_TRIANGLE, columns, strict=True):
        a[i, j] = a[j, i] = column
    q = torch.zeros_like(a[0, 0]).repeat(4, 1)
    q[0] = 1.0
    for _ in range(JACOBI_SWEEPS):
        for i, j in ((0, 1), (1, 2), (2, 0)):
            half = _turn(a, i, j)
            q = _times(q, half.cos(), 3 - i - j, half.sin())
    return torch.stack([a[i, i] for i in range(3)], 1).float(), q.T.float().contiguous()


def _turn(a: Float[Tensor, "3 3 m"], i: int, j: int) -> Float[Tensor, " m"]:
    """Turn the axes i and j, which follow each other, so that a[i, j] becomes 0; returns half of the angles."""
    apart = a[i, i] - a[j, j]
    # The smaller of the two angles that do it, at most 45 degrees: axes keep their names where they can.
    angle = 0.5 * torch.atan2(2 * a[i, j] * torch.ones_like(apart).copysign(apart), apart.abs())
    c, s = angle.cos(), angle.sin()
    a[i], a[j] = c * a[i] + s * a[j], c * a[j] - s * a[i]
    a[:, i], a[:, j] = c * a[:, i] + s * a[:, j], c * a[:, j] - s * a[:, i]
    return angle / 2


def _times(q: Float[Tensor, "4 m"], w: Tensor, axis: int, v: Tensor) -> Float[Tensor, "4 m"]:
    """The products of quaternions with (w, v along one axis)."""
    after, last = 1 + (axis + 1) % 3, 1 + (axis + 2) % 3
    product = torch.empty_like(q)
    product[0] = q[0] * w - q[1 + axis] * v
    product[1 + axis] = q[1 + axis] * w + q[0] * v
    product[after] = q[after] * w + q[last] * v
    product[last] = q[last] * w - q[after] * v
    return product
