"""Splats to a picture, in C++ on the CPU (kernels/native/cpu/rasterize/rasterize.h)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.autograd import (
    Drawn,
    check_picture_gradients,
    check_splat_outputs,
    check_splats,
    rasterize_with_autograd,
)
from vdgs.kernels.cpu import extension as native_module
from vdgs.kernels.cpu.arguments import check_outputs, new_floats
from vdgs.kernels.kernel_types import Raster, RasterGradients, RasterPullback, SplatContributions, Splats


def rasterize(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False, module: Any = None
) -> Raster:
    """Blend splats front to back (3DGS, eqs. 2-3), differentiable in their five tensors and the background.

    All are float32 on the CPU. `depth` adds the expected depth, the sum of w_i depth_i (neither divided by alpha nor
    given a background), and the median depth, which is not differentiable. `module` is the build of the kernels to use
    (default: that of this process). A splat whose row holds NaN or infinity, or whose conic is not positive definite,
    is not drawn and its gradient is zero. Same bits for any number of threads. Raises TypeError or ValueError for
    tensors of another dtype, device or shape, or a side outside 1 .. 524272 pixels; RuntimeError for second
    derivatives.
    """

    def draw(tensors: tuple[Tensor, ...]) -> Drawn:
        raster, pullback = _draw(tensors, width, height, depth, module)
        return Drawn(raster, (), lambda: pullback)

    return rasterize_with_autograd(draw, splats, background)


def rasterize_vjp(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False, module: Any = None
) -> tuple[Raster, RasterPullback]:
    """`rasterize` without autograd: the image and its pullback, which keeps none of the arguments (their memory may be
    reused). Raises what `rasterize` raises."""
    return _draw((*splats.tensors, background), width, height, depth, module)


def splat_contributions(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    wanted: Float[Tensor, "h w 3"] | None = None,
    *,
    module: Any = None,
) -> SplatContributions:
    """As `torch_ref.splat_contributions`, by a second pass with four sums for each splat of a tile, where backward has
    ten. Same bits for any number of threads."""
    raster, pullback = _draw((*splats.tensors, background), width, height, False, module)
    lacking = torch.zeros_like(raster.image) if wanted is None else wanted - raster.image
    found = SplatContributions(new_floats(pullback.count), new_floats(pullback.count, 3))
    pullback.module.rasterize_shares(pullback.frame, lacking.contiguous().numpy(), *(t.numpy() for t in found))
    return found


def _draw(tensors: tuple[Tensor, ...], width: int, height: int, depth: bool, module: Any) -> tuple[Raster, _Pullback]:
    """The picture of means_px, conics, colors, opacities, depths before a background, and the way back."""
    check_splats(tensors, width, height, "cpu")
    module = module or native_module.get_extension()
    depths = (new_floats(height, width), new_floats(height, width)) if depth else (None, None)
    raster = Raster(new_floats(height, width, 3), new_floats(height, width), *depths)
    behind = tuple(tensors[5].tolist())
    frame = module.rasterize_forward(
        *(t.detach().contiguous().numpy() for t in tensors[:5]), behind, width, height,
        *(None if t is None else t.numpy() for t in raster),
    )  # fmt: skip
    return raster, _Pullback(frame, module, len(tensors[0]), behind, depth, (height, width))


@dataclass(frozen=True)
class _Pullback:
    """A `RasterPullback` and what it keeps of an image."""

    frame: Any
    module: Any
    count: int
    background: tuple[float, ...]
    with_depth: bool
    size: tuple[int, int]

    def __call__(
        self,
        image: Tensor | None,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        out: tuple[Tensor, Tensor] | None = None,
        count: int | None = None,
    ) -> RasterGradients:
        check_picture_gradients(*self.size, image, alpha, depth)
        n = self.count if count is None else count
        means, conics = out or (new_floats(n, 2), new_floats(n, 3))
        check_splat_outputs(self.count, n, means, conics)
        check_outputs(means=means, conics=conics)
        colors, opacities, background = new_floats(n, 3), new_floats(n), new_floats(3)
        depths = new_floats(n) if self.with_depth else None
        found = RasterGradients(means, conics, colors, opacities, depths, background)
        self.module.rasterize_backward(
            self.frame, self.background,
            *(None if g is None else g.contiguous().numpy() for g in (image, alpha, depth)),
            *(None if t is None else t.numpy() for t in found),
        )  # fmt: skip
        return found
