"""Splats to a picture, as plain as torch allows: every splat at every pixel."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.autograd import vjp_from_autograd
from vdgs.kernels.constants import ALPHA_MAX, ALPHA_MIN, MEDIAN_TRANSMITTANCE, TRANSMITTANCE_MIN
from vdgs.kernels.kernel_types import Raster, RasterPullback, SplatContributions, Splats


def rasterize(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False
) -> Raster:
    """Blend splats front to back (3DGS, eqs. 2-3); see vdgs.kernels.cpu.rasterize, whose twin this is.

    Works in the precision of its input and takes O(m h w) memory.
    """
    tensors = splats.tensors
    a, b, c = splats.conics.unbind(dim=1)
    rows = torch.cat([*tensors[:3], splats.opacities[:, None], splats.depths[:, None]], dim=1)
    drawn = rows.isfinite().all(dim=1) & (a > 0) & (c > 0) & (a * c - b * b > 0)
    order = torch.argsort(splats.depths[drawn], stable=True)
    means_px, conics, colors, opacities, depths = (tensor[drawn][order] for tensor in tensors)
    alpha = _alphas(means_px, conics, opacities, width, height)
    with torch.no_grad():
        # A pixel ends before the splat that would take its transmittance below the minimum.
        stopped = torch.cumprod(1 - alpha, dim=0) < TRANSMITTANCE_MIN
    alpha = alpha.masked_fill(stopped, 0.0)
    one = alpha.new_ones(1, height, width)
    transmittance = torch.cat([one, torch.cumprod(1 - alpha, dim=0)])
    weights = alpha * transmittance[:-1]
    through = transmittance[-1]
    image = torch.einsum("mhw,mc->hwc", weights, colors) + through[..., None] * background
    if not depth:
        return Raster(image, 1 - through, None)
    expected_depth = torch.einsum("mhw,m->hw", weights, depths)
    return Raster(image, 1 - through, expected_depth, _median_depth(transmittance, depths))


def rasterize_vjp(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False
) -> tuple[Raster, RasterPullback]:
    """`rasterize` without autograd for the caller: the picture, and the way back from it (by autograd in here)."""

    def draw(splats: Splats, background: Tensor) -> Raster:
        return rasterize(splats, background, width, height, depth=depth)

    return vjp_from_autograd(draw, splats, background)


def splat_contributions(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    wanted: Float[Tensor, "h w 3"] | None = None,
) -> SplatContributions:
    """How many pixels each splat makes, the sum of its weights w = alpha T over them (3DGS, eq. 3), and the sum of w
    times what the picture lacks there of the wanted one (zero without).

    These are the derivatives of the sum of the expected depth by the depth of the splat, and, by its color, of half of
    the squared error of the picture, negated. Raises what `rasterize` raises.
    """
    return splat_contributions_from_vjp(rasterize_vjp, splats, background, width, height, wanted)


def splat_contributions_from_vjp(
    draw: Callable[..., tuple[Raster, RasterPullback]],
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    wanted: Float[Tensor, "h w 3"] | None,
) -> SplatContributions:
    """The same by any `rasterize_vjp`."""
    raster, pullback = draw(splats, background, width, height, depth=True)
    lacking = torch.zeros_like(raster.image) if wanted is None else wanted - raster.image
    found = pullback(lacking, None, torch.ones_like(raster.alpha))
    assert found.depths is not None
    return SplatContributions(found.depths, found.colors)


@torch.no_grad()
def _median_depth(transmittance: Float[Tensor, "m_and_one h w"], depths: Float[Tensor, "m"]) -> Float[Tensor, "h w"]:
    """Depth of the splat at which transmittance, which never grows, falls below one half; 0 where it does not.

    `transmittance` is that before each splat, and behind the last.
    """
    crossing = (transmittance[:-1] >= MEDIAN_TRANSMITTANCE) & (transmittance[1:] < MEDIAN_TRANSMITTANCE)
    return torch.einsum("mhw,m->hw", crossing.to(depths.dtype), depths)


def _alphas(
    means_px: Float[Tensor, "m 2"], conics: Float[Tensor, "m 3"], opacities: Float[Tensor, "m"], width: int, height: int
) -> Float[Tensor, "m h w"]:
    """Opacity of every splat at every pixel center, zero where it is too small to count."""
    x = torch.arange(width, dtype=means_px.dtype, device=means_px.device) + 0.5
    y = torch.arange(height, dtype=means_px.dtype, device=means_px.device) + 0.5
    dx = (x - means_px[:, 0, None])[:, None, :]
    dy = (y - means_px[:, 1, None])[:, :, None]
    a, b, c = (conics[:, i, None, None] for i in range(3))
    falloff = torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = (opacities[:, None, None] * falloff).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
