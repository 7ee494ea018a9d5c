"""Spherical harmonics of many Gaussians in C++: sixteen Gaussians side by side, threaded by Gaussians."""

from __future__ import annotations

from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import new_floats
from vdgs.kernels.spherical_harmonics import num_sh_bases
from vdgs.kernels.torch_ref.harmonics import check_coefficients, check_starts


def harmonic_colors(
    means: Float[Tensor, "m 3"], coefficients: Float[Tensor, "n c"], rows: Int64[Tensor, " m"],
    eye: Float[Tensor, "3"], degree: int,
) -> Float[Tensor, "m 3"]:  # fmt: skip
    """As `torch_ref.harmonic_colors`. Same bits for any number of threads."""
    check_coefficients(coefficients, rows, degree)
    check_row_shapes(len(rows), means=(means, 3))
    check_row_shapes(3, eye=(eye,))
    if coefficients.stride(1) != 1:
        coefficients = coefficients.contiguous()
    colors = new_floats(len(rows), 3)
    extension.get_extension().harmonic_colors(means.contiguous(), coefficients, rows, eye.contiguous(), degree, colors)
    return colors


def fit_harmonics(
    directions: Float[Tensor, "p 3"], colors: Float[Tensor, "p 3"], weights: Float[Tensor, " p"],
    starts: Int64[Tensor, " m"], degree: int, ridge: float,
) -> Float[Tensor, "m f 3"]:  # fmt: skip
    """As `torch_ref.fit_harmonics`. Same bits for any number of threads."""
    f = num_sh_bases(degree)
    check_starts(starts, len(weights))
    check_row_shapes(len(weights), directions=(directions, 3), colors=(colors, 3), weights=(weights,))
    found = new_floats(len(starts), 3 * f)
    extension.get_extension().fit_harmonics(
        directions.contiguous(), colors.contiguous(), weights.contiguous(), starts, degree, ridge, found
    )
    return found.view(-1, f, 3)
