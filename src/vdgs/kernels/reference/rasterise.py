"""Splats to a picture, as plain as torch allows: every splat at every pixel."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.constants import ALPHA_MAX, ALPHA_MIN, MEDIAN_TRANSMITTANCE, TRANSMITTANCE_MIN
from vdgs.kernels.types import Raster, RasterGradients, RasterPullback, Splats

#: The largest picture side: tiles are numbered with 16 bits.
MAX_SIDE = 16 * 32767


def rasterise(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    *,
    depth: bool = False,
) -> Raster:
    """Blend splats front to back (3DGS, eqs. 2-3); see vdgs.kernels.native.rasterise, whose twin this is.

    Works in the precision of its input and takes O(m h w) memory.
    """
    tensors = (splats.means_px, splats.conics, splats.colours, splats.opacities, splats.depths)
    a, b, c = splats.conics.unbind(dim=1)
    rows = torch.cat([*tensors[:3], splats.opacities[:, None], splats.depths[:, None]], dim=1)
    drawn = rows.isfinite().all(dim=1) & (a > 0) & (c > 0) & (a * c - b * b > 0)
    order = torch.argsort(splats.depths[drawn], stable=True)
    means_px, conics, colours, opacities, depths = (tensor[drawn][order] for tensor in tensors)
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
    if not depth:
        return Raster(image, 1 - through, None)
    expected_depth = torch.einsum("mhw,m->hw", weights, depths)
    return Raster(image, 1 - through, expected_depth, _median_depth(transmittance, depths))


def rasterise_vjp(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    *,
    depth: bool = False,
) -> tuple[Raster, RasterPullback]:
    """`rasterise` without autograd for the caller: the picture, and the way back from it (by autograd in here)."""

    def draw(splats: Splats, background: Tensor) -> Raster:
        return rasterise(splats, background, width, height, depth=depth)

    return pulled_back(draw, splats, background)


def pulled_back(
    draw: Callable[[Splats, Tensor], Raster], splats: Splats, background: Float[Tensor, "3"]
) -> tuple[Raster, RasterPullback]:
    """What a function draws that autograd can differentiate, and the way back, with autograd kept in here."""
    inputs = (splats.means_px, splats.conics, splats.colours, splats.opacities, splats.depths, background)
    leaves = [tensor.detach().clone().requires_grad_(True) for tensor in inputs]
    means_px, conics, colours, opacities, depths, behind = leaves
    with torch.enable_grad():
        drawn = draw(Splats(means_px, conics, depths, colours, opacities), behind)

    def pullback(
        image: Tensor | None,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        over: tuple[Tensor, Tensor] | None = None,
    ) -> RasterGradients:
        made = {"image": image, "alpha": alpha, "depth": depth}
        received = {name: gradient for name, gradient in made.items() if gradient is not None}
        found = torch.autograd.grad(
            [getattr(drawn, name) for name in received], leaves, list(received.values()),
            allow_unused=True, materialize_grads=True,
        )  # fmt: skip
        for place, gradient in zip(over or (), found, strict=False):
            place.copy_(gradient)
        means, conics = over or found[:2]
        of_depths = None if drawn.depth is None else found[4]
        return RasterGradients(means, conics, found[2], found[3], of_depths, found[5])

    shown_depth = None if drawn.depth is None else drawn.depth.detach()
    return Raster(drawn.image.detach(), drawn.alpha.detach(), shown_depth, drawn.median_depth), pullback


@torch.no_grad()
def _median_depth(transmittance: Float[Tensor, "m_and_one h w"], depths: Float[Tensor, "m"]) -> Float[Tensor, "h w"]:
    """Depth of the splat at which transmittance, which never grows, falls below one half; 0 where it does not.

    `transmittance` is that before each splat, and behind the last.
    """
    crossing = (transmittance[:-1] >= MEDIAN_TRANSMITTANCE) & (transmittance[1:] < MEDIAN_TRANSMITTANCE)
    return torch.einsum("mhw,m->hw", crossing.to(depths.dtype), depths)


def _alphas(
    means_px: Float[Tensor, "m 2"],
    conics: Float[Tensor, "m 3"],
    opacities: Float[Tensor, "m"],
    width: int,
    height: int,
) -> Float[Tensor, "m h w"]:
    """Opacity of every splat at every pixel centre, zero where it is too small to count."""
    x = torch.arange(width, dtype=means_px.dtype, device=means_px.device) + 0.5
    y = torch.arange(height, dtype=means_px.dtype, device=means_px.device) + 0.5
    dx = (x - means_px[:, 0, None])[:, None, :]
    dy = (y - means_px[:, 1, None])[:, :, None]
    a, b, c = (conics[:, i, None, None] for i in range(3))
    falloff = torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = (opacities[:, None, None] * falloff).clamp(max=ALPHA_MAX)
    return torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))


def check_splats(tensors: tuple[Tensor, ...], width: int, height: int, device_type: str | None = None) -> None:
    """Raise a clear error unless these are means_px, conics, colours, opacities, depths and a background, float32 (and
    on a kind of device, if one is named), and the sides those of a picture that can be drawn."""
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name} must be from 1 to {MAX_SIDE} pixels, not {side}")
    n = len(tensors[0]) if tensors[0].dim() else 0
    shapes = ((n, 2), (n, 3), (n, 3), (n,), (n,), (3,))
    names = ("means_px", "conics", "colours", "opacities", "depths", "background")
    for name, tensor, shape in zip(names, tensors, shapes, strict=True):
        if tensor.dtype != torch.float32 or device_type not in (None, tensor.device.type):
            where = {None: "", "cpu": " on the CPU"}.get(device_type, f" on {device_type}")
            raise TypeError(f"{name} must be float32{where}, not {tensor.dtype} on {tensor.device}")
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")
