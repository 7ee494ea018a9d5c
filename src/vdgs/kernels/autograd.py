"""The bridge to autograd and back; shared by the rasterizers: checks of their arguments."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.kernel_types import Raster, RasterGradients, RasterPullback, Splats

#: The largest picture side: tiles are numbered with 16 bits.
MAX_IMAGE_SIDE_PX = 16 * 32767
#: Splats are numbered with 31 bits.
MAX_SPLATS = 2**31 - 1


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """The `backward` of a function without second derivatives: RuntimeError where they are asked for.

    That of torch refuses too late: `torch.autograd.grad` by chosen tensors passes its error by, and where gradients do
    not depend on the tensors it has none. Both take second derivatives for zero.
    """

    @wraps(backward)
    def run(ctx: Any, *gradients: Tensor | None) -> Any:
        if torch.is_grad_enabled():
            raise RuntimeError(
                "trying to differentiate twice what the kernels of vdgs differentiate once: leave out "
                "create_graph=True, or set VDGS_KERNELS=torch_ref, which is slower"
            )
        return backward(ctx, *gradients)

    return run


class Drawn(NamedTuple):
    """An image, and the way back from it."""

    raster: Raster
    #: What the way back reads of the image. Autograd keeps it apart, and sees whether it was changed: a pullback that
    #: held it would hang on what hangs on it, and neither would ever be freed.
    read: tuple[Tensor | None, ...]
    #: From `read` to the pullback.
    pullback_of: Callable[..., RasterPullback]

    def with_pullback(self) -> tuple[Raster, RasterPullback]:
        """Where autograd has no part in it."""
        return self.raster, self.pullback_of(*self.read)


#: From the tensors of splats (`Splats.tensors`) and the background to the image.
RasterizeFn = Callable[[tuple[Tensor, ...]], Drawn]


def rasterize_with_autograd(draw: RasterizeFn, splats: Splats, background: Tensor) -> Raster:
    """The image over a background [3], differentiable once by splats and background. RuntimeError for a second
    derivative, and where what the way back reads of the image was changed."""
    return Raster(*_Drawn.apply(draw, *splats.tensors, background))


class _Drawn(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, draw: RasterizeFn, *tensors: Tensor) -> Raster:
        raster, read, ctx.pullback_of = draw(tensors)
        ctx.save_for_backward(*read)
        if raster.median_depth is not None:
            ctx.mark_non_differentiable(raster.median_depth)
        ctx.set_materialize_grads(False)
        return raster

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *picture_gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        image, alpha, depth, _ = picture_gradients
        return None, *ctx.pullback_of(*ctx.saved_tensors)(image, alpha, depth)


def vjp_from_autograd(
    draw: Callable[[Splats, Tensor], Raster], splats: Splats, background: Float[Tensor, "3"]
) -> tuple[Raster, RasterPullback]:
    """The image of a function that autograd differentiates, and its pullback, with autograd kept inside."""
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
        received = {name: g for name, g in (("image", image), ("alpha", alpha), ("depth", depth)) if g is not None}
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


def check_splats(tensors: tuple[Tensor, ...], width: int, height: int, device_type: str | None = None) -> None:
    """Raise TypeError or ValueError unless these are means_px, conics, colors, opacities, depths and a background,
    float32 (on `device_type`, if given), and the image has a size that can be drawn."""
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"{name} must be from 1 to {MAX_IMAGE_SIDE_PX} pixels, not {side}")
    n = len(tensors[0]) if tensors[0].dim() else 0
    if n > MAX_SPLATS:
        raise ValueError(f"at most 2^31 - 1 splats can be drawn at once, not {n}")
    shapes = ((n, 2), (n, 3), (n, 3), (n,), (n,), (3,))
    names = ("means_px", "conics", "colors", "opacities", "depths", "background")
    for name, tensor, shape in zip(names, tensors, shapes, strict=True):
        if tensor.dtype != torch.float32 or device_type not in (None, tensor.device.type):
            where = {None: "", "cpu": " on the CPU"}.get(device_type, f" on {device_type}")
            raise TypeError(f"{name} must be float32{where}, not {tensor.dtype} on {tensor.device}")
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")


def check_splat_outputs(splats: int, count: int, means: Tensor, conics: Tensor) -> None:
    """Raise ValueError unless gradients of the first `count` of so many splats fit into these two tensors."""
    if not 0 <= count <= splats or means.shape != (count, 2) or conics.shape != (count, 3):
        raise ValueError(
            f"gradients of {count} splats of {splats} do not fit into {list(means.shape)} and {list(conics.shape)}"
        )


def check_picture_gradients(
    height: int, width: int, image: Tensor | None, alpha: Tensor | None, depth: Tensor | None
) -> None:
    """Raise TypeError or ValueError unless the gradients that a pullback is given are float32 and of the picture's
    size: kernels do not look again."""
    for name, gradient, tail in (("image", image, (3,)), ("alpha", alpha, ()), ("depth", depth, ())):
        if gradient is None:
            continue
        if gradient.dtype != torch.float32:
            raise TypeError(f"the gradient by {name} must be float32, not {gradient.dtype}")
        if tuple(gradient.shape) != (height, width, *tail):
            raise ValueError(
                f"the gradient by {name} must have shape {[height, width, *tail]}, not {list(gradient.shape)}"
            )
