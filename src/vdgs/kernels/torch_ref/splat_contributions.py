"""What each splat makes of a picture: derivatives by colours."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.kernel_types import Raster, RasterPullback, SplatContributions, Splats
from vdgs.kernels.torch_ref.rasterize import rasterize_vjp


def splat_contributions(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    wanted: Float[Tensor, "h w 3"] | None = None,
) -> SplatContributions:
    """How many pixels each splat makes, the sum of its weights w = alpha T over them (3DGS, eq. 3), and the sum of w
    times what the picture lacks there of the wanted one (zero without).

    These are the derivatives of the sum of the expected depth by the depth of the splat, and, by its colour, of half of
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
