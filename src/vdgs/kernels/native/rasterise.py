"""Splats to a picture, in C++ on the CPU (native/cpu/rasterise/rasterise.h)."""

from __future__ import annotations

from dataclasses import dataclass
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
    return Raster(*_Rasterise.apply(width, height, depth, module, *tensors))


def rasterise_by_hand(
    *tensors: Tensor, width: int, height: int, depth: bool = False, module: Any = None
) -> tuple[Raster, Drawing]:
    """`rasterise` without autograd, for the same six tensors: the picture, and the way back from it."""
    _check(tensors, width, height)
    module = module or native_module.native()
    raster = Raster(
        torch.empty(height, width, 3), torch.empty(height, width), torch.empty(height, width) if depth else None
    )
    background = tuple(tensors[5].tolist())
    frame = module.rasterise_forward(
        *(t.detach().contiguous().numpy() for t in tensors[:5]), background, width, height,
        *(None if t is None else t.numpy() for t in raster),
    )  # fmt: skip
    return raster, Drawing(frame, module, len(tensors[0]), background, depth)


@dataclass(frozen=True)
class Drawing:
    """What is kept of a picture for its backward pass: nothing of the tensors that went in or came out."""

    frame: Any
    module: Any
    count: int
    background: tuple[float, ...]
    with_depth: bool

    def backward(
        self,
        image: Tensor | None,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        over: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None, Tensor]:
        """Gradients of the six tensors, from those of the picture. None: zero. No gradient of depths without depth.

        Those of means_px and conics overwrite the contiguous tensors `over`, if given.
        """
        n = self.count
        means, conics = over or (torch.empty(n, 2), torch.empty(n, 3))
        colours, opacities, background = torch.empty(n, 3), torch.empty(n), torch.empty(3)
        depths = torch.empty(n) if self.with_depth else None
        found = (means, conics, colours, opacities, depths, background)
        self.module.rasterise_backward(
            self.frame, self.background,
            *(None if g is None else g.contiguous().numpy() for g in (image, alpha, depth)),
            *(None if t is None else t.numpy() for t in found),
        )  # fmt: skip
        return found


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, width: int, height: int, with_depth: bool, module: Any, *tensors: Tensor) -> Raster:
        raster, ctx.drawing = rasterise_by_hand(*tensors, width=width, height=height, depth=with_depth, module=module)
        ctx.set_materialize_grads(False)
        return raster

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *picture_gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        return None, None, None, None, *ctx.drawing.backward(*picture_gradients)


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
