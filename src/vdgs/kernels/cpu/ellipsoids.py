"""Means of ellipsoids in C++: eight Gaussians side by side, threaded by Gaussians."""

from __future__ import annotations

from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import new_floats
from vdgs.kernels.torch_ref.harmonics import check_starts


def mean_ellipsoids(
    log_scales: Float[Tensor, "p 3"], quaternions: Float[Tensor, "p 4"], weights: Float[Tensor, " p"],
    starts: Int64[Tensor, " m"],
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 4"]]:  # fmt: skip
    """As `torch_ref.mean_ellipsoids`. Same bits for any number of threads."""
    check_starts(starts, len(weights))
    check_row_shapes(len(weights), log_scales=(log_scales, 3), quaternions=(quaternions, 4), weights=(weights,))
    found = new_floats(len(starts), 3), new_floats(len(starts), 4)
    given = (each.contiguous() for each in (log_scales, quaternions, weights))
    extension.get_extension().mean_ellipsoids(*given, starts, *found)
    return found
