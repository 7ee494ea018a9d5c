"""Splats to a picture, in C++ on the CPU (native/cpu/rasterise.h)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from vdgs.kernels.native import module as native_module
from vdgs.kernels.types import Raster

#: The largest picture side: tiles are numbered with 16 bits.
MAX_SIDE = 16 * 32767


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
    module: Any = None,
) -> Raster:
    """Blend splats front to back (3DGS, eqs. 2-3), differentiable in all six tensors.

    means_px: centres in pixels; the centre of the first pixel is (0.5, 0.5). conics: (a, b, c) of
    a dx^2 + 2 b dx dy + c dy^2. depths: along the viewing direction; equal ones keep the order of the
    rows. All are float32 on the CPU. `depth` asks for the expected depth, the sum of w_i depth_i, neither
    divided by alpha nor given a background; without it the picture costs nothing extra. Thresholds as in
    vdgs.kernels.constants. `module` is the build of the kernels to use (default: the one of this process).

    A splat whose row holds NaN or infinity, or whose conic is not positive definite, is not drawn and
    its gradient is zero. The result has the same bits for any number of threads.

    Raises TypeError or ValueError for tensors of another type, device or shape, or a picture side
    outside 1 .. 524272. The second derivative is not defined: asking for it raises RuntimeError.
    """
    tensors = (means_px, conics, colours, opacities, depths, background)
    _check(tensors, width, height)
    image, alpha, expected_depth = _Rasterise.apply(*tensors, width, height, depth, module or native_module.native())
    return Raster(image, alpha, expected_depth)


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means_px: Tensor,
        conics: Tensor,
        colours: Tensor,
        opacities: Tensor,
        depths: Tensor,
        background: Tensor,
        width: int,
        height: int,
        with_depth: bool,
        module: Any,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        image = torch.empty(height, width, 3)
        alpha = torch.empty(height, width)
        depth = torch.empty(height, width) if with_depth else None
        rows = [t.detach().contiguous().numpy() for t in (means_px, conics, colours, opacities, depths)]
        back = tuple(background.tolist())
        frame = module.rasterise_forward(
            *rows, back, width, height, image.numpy(), alpha.numpy(), None if depth is None else depth.numpy()
        )
        ctx.set_materialize_grads(False)
        ctx.frame, ctx.background, ctx.module, ctx.n, ctx.with_depth = (
            frame,
            back,
            module,
            len(depths),
            with_depth,
        )
        return image, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *picture_gradients: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        received = [None if g is None else g.contiguous().numpy() for g in picture_gradients]
        means, conics, colours = torch.empty(ctx.n, 2), torch.empty(ctx.n, 3), torch.empty(ctx.n, 3)
        opacities, background = torch.empty(ctx.n), torch.empty(3)
        depths = torch.empty(ctx.n) if ctx.with_depth else None
        ctx.module.rasterise_backward(
            ctx.frame,
            ctx.background,
            *received,
            *(t.numpy() for t in (means, conics, colours, opacities)),
            None if depths is None else depths.numpy(),
            background.numpy(),
        )
        return means, conics, colours, opacities, depths, background, None, None, None, None


def _check(tensors: tuple[Tensor, ...], width: int, height: int) -> None:
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_SIDE:
            raise ValueError(f"{name} must be from 1 to {MAX_SIDE} pixels, not {side}")
    n = len(tensors[0]) if tensors[0].dim() else 0
    shapes = ((n, 2), (n, 3), (n, 3), (n,), (n,), (3,))
    names = ("means_px", "conics", "colours", "opacities", "depths", "background")
    for name, tensor, shape in zip(names, tensors, shapes, strict=True):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise TypeError(f"{name} must be float32 on the CPU, not {tensor.dtype} on {tensor.device}")
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")
    if n >= 2**31:
        raise ValueError(f"at most 2^31 - 1 splats can be drawn at once, not {n}")
