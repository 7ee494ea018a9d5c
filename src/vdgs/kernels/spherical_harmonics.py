"""Color that depends on the viewing direction: real spherical harmonics up to degree 3.

Functions Y_l^m in the order (0,0), (1,-1), (1,0), (1,1), (2,-2), ..., (3,3), orthonormal on the sphere, with the
Condon-Shortley phase (-1)^m: the layout of the files of 3DGS.
"""

from __future__ import annotations

from math import pi, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

MAX_SH_DEGREE = 3
#: The constant function Y_0^0.
SH_C0 = sqrt(1 / (4 * pi))


def num_sh_bases(degree: int) -> int:
    """How many functions there are up to this degree. Raises ValueError outside 0 .. 3."""
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"the degree must be from 0 to {MAX_SH_DEGREE}, not {degree}")
    return (degree + 1) ** 2


def eval_sh_bases(directions: Float[Tensor, "m 3"], degree: int) -> Float[Tensor, "m f"]:
    """The functions up to `degree` at unit directions, f = (degree + 1)²; differentiable. Raises ValueError."""
    num_sh_bases(degree)
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        a = sqrt(3 / (4 * pi))
        values += [-a * y, a * z, -a * x]
    if degree >= 2:
        a = sqrt(15 / (4 * pi))
        values += [a * x * y, -a * y * z, sqrt(5 / (16 * pi)) * (3 * z * z - 1), -a * x * z, a / 2 * (x * x - y * y)]
    if degree >= 3:
        a, b, c = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi))
        values += [
            -a * y * (3 * x * x - y * y), b * x * y * z, -c * y * (5 * z * z - 1),
            sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1), b / 2 * z * (x * x - y * y), -a * x * (x * x - 3 * y * y),
        ]  # fmt: skip
    return torch.stack(values, -1)


def eval_sh_colors(
    dc: Float[Tensor, "m 3"], rest: Float[Tensor, "m r 3"], directions: Float[Tensor, "m 3"], degree: int
) -> Float[Tensor, "m 3"]:
    """RGB seen along unit directions (from the camera to the Gaussian): 1/2 + Σ c_lm Y_lm, not below 0.

    `dc` are the coefficients of Y_0^0, `rest` those of the other functions, of which only the ones up to `degree` are
    looked at. Differentiable in all three. Raises ValueError where `rest` holds too few.
    """
    used = num_sh_bases(degree) - 1
    if rest.shape[1] < used:
        raise ValueError(f"degree {degree} needs {used} further coefficients, there are {rest.shape[1]}")
    colors = 0.5 + SH_C0 * dc
    if used:
        weights = eval_sh_bases(directions, degree)[:, 1:]
        colors = colors + torch.bmm(weights[:, None], rest[:, :used])[:, 0]
    return colors.clamp_min(0.0)


def rgb_to_sh(colors: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """The coefficients of Y_0^0 that show these RGB colors in [0, 1] from everywhere."""
    return (colors - 0.5) / SH_C0
