"""Between rasterisers and autograd: what knows its own way back is made known to autograd, and the other way round."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vdgs.kernels.kernel_types import Raster, RasterGradients, RasterPullback, Splats

#: From the tensors of splats (`Splats.tensors`) and the background to the picture and the way back from it.
RasterizeFn = Callable[[tuple[Tensor, ...]], tuple[Raster, RasterPullback]]


def rasterize_with_autograd(draw: RasterizeFn, splats: Splats, background: Tensor) -> Raster:
    """The picture before a background [3]. Gradients of image, alpha and expected depth find back to splats and
    background, once: the second derivative is not defined, and asking for it raises RuntimeError."""
    return Raster(*_Drawn.apply(draw, *splats.tensors, background))


class _Drawn(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, draw: RasterizeFn, *tensors: Tensor) -> Raster:
        raster, ctx.pullback = draw(tensors)
        if raster.median_depth is not None:
            ctx.mark_non_differentiable(raster.median_depth)
        ctx.set_materialize_grads(False)
        return raster

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *picture_gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        image, alpha, depth, _ = picture_gradients
        return None, *ctx.pullback(image, alpha, depth)


def vjp_from_autograd(
    draw: Callable[[Splats, Tensor], Raster], splats: Splats, background: Float[Tensor, "3"]
) -> tuple[Raster, RasterPullback]:
    """What a function draws that autograd can differentiate, and the way back, with autograd kept in here."""
    inputs = (*splats.tensors, background)
    leaves = [tensor.detach().clone().requires_grad_(True) for tensor in inputs]
    means_px, conics, colors, opacities, depths, behind = leaves
    with torch.enable_grad():
        drawn = draw(Splats(means_px, conics, depths, colors, opacities), behind)

    def pullback(
        image: Tensor | None,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        out: tuple[Tensor, Tensor] | None = None,
        count: int | None = None,
    ) -> RasterGradients:
        made = {"image": image, "alpha": alpha, "depth": depth}
        received = {name: gradient for name, gradient in made.items() if gradient is not None}
        *by_splats, by_background = torch.autograd.grad(
            [getattr(drawn, name) for name in received], leaves, list(received.values()),
            allow_unused=True, materialize_grads=True,
        )  # fmt: skip
        by_means, by_conics, by_colors, by_opacities, by_depths = (each[:count] for each in by_splats)
        for place, gradient in zip(out or (), (by_means, by_conics), strict=False):
            place.copy_(gradient)
        means, conics = out or (by_means, by_conics)
        of_depths = None if drawn.depth is None else by_depths
        return RasterGradients(means, conics, by_colors, by_opacities, of_depths, by_background)

    shown_depth = None if drawn.depth is None else drawn.depth.detach()
    return Raster(drawn.image.detach(), drawn.alpha.detach(), shown_depth, drawn.median_depth), pullback
