"""Splats to a picture, as plain as torch allows: every splat at every pixel."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from vdgs.kernels.types import Raster


def rasterise(
    means_px: Float[Tensor, "m 2"],
    conics: Float[Tensor, "m 3"],
    colours: Float[Tensor, "m 3"],
    opacities: Float[Tensor, "m"],
    depths: Float[Tensor, "m"],
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    *,
    depth: bool = False,
) -> Raster:
    """Blend splats front to back (3DGS, eqs. 2-3); see vdgs.kernels.native.rasterise, whose twin this is.

    Works in the precision of its input and takes O(m h w) memory.
    """
    rows = torch.cat([means_px, conics, colours, opacities[:, None], depths[:, None]], dim=1)
    a, b, c = conics.unbind(dim=1)
    drawn = rows.isfinite().all(dim=1) & (a > 0) & (c > 0) & (a * c - b * b > 0)
    order = torch.argsort(depths[drawn], stable=True)
    means_px, conics, colours, opacities, depths = (
        t[drawn][order] for t in (means_px, conics, colours, opacities, depths)
    )
    alpha = _alphas(means_px, conics, opacities, width, height)
    with torch.no_grad():
        # A pixel ends before the splat that would take its transmittance below the minimum.
        stopped = torch.cumprod(1 - alpha, dim=0) < TRANSMITTANCE_MIN
    alpha = alpha.masked_fill(stopped, 0.0)
    one = alpha.new_ones(1, height, width)
    transmittance = torch.cat([one, torch.cumprod(1 - alpha, dim=0)])
    weights = alpha * transmittance[:-1]
    through = transmittance[-1]
    image = torch.einsum("mhw,mc->hwc", weights, colours) + through[..., None] * background
    expected_depth = torch.einsum("mhw,m->hw", weights, depths) if depth else None
    return Raster(image, 1 - through, expected_depth)


def _alphas(
    means_px: Float[Tensor, "m 2"],
    conics: Float[Tensor, "m 3"],
    opacities: Float[Tensor, "m"],
    width: int,
    height: int,
) -> Float[Tensor, "m h w"]:
    """Opacity of every splat at every pixel centre, zero where it is too small to count."""
    x = torch.arange(width, dtype=means_px.dtype) + 0.5
    y = torch.arange(height, dtype=means_px.dtype) + 0.5
    dx = (x - means_px[:, 0, None])[:, None, :]
    dy = (y - means_px[:, 1, None])[:, :, None]
    a, b, c = (conics[:, i, None, None] for i in range(3))
    falloff = torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = (opacities[:, None, None] * falloff).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
