"""Photometric loss in C++: L1 and SSIM with their gradient in one pass over the image."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vdgs.kernels.autograd import once_differentiable
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import new_floats
from vdgs.kernels.kernel_types import PhotometricLoss
from vdgs.kernels.torch_ref.loss import check_float32_images


def photometric_loss(
    image: Float[Tensor, "h w 3"],
    target: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"] | None = None,
    *,
    ssim_weight: float = 0.2,
) -> PhotometricLoss:
    """As `torch_ref.photometric_loss`, for float32 images. Differentiable once; the gradient is computed with the loss.
    Same bits for any number of threads. Takes some 0.5 MB a thread beside the gradient."""
    check_float32_images(image, target, mask)
    return PhotometricLoss(*_Photometric.apply(image, target, mask, ssim_weight))


def photometric_loss_vjp(
    image: Float[Tensor, "h w 3"],
    target: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"] | None = None,
    *,
    ssim_weight: float = 0.2,
) -> tuple[PhotometricLoss, Float[Tensor, "h w 3"]]:
    """As `torch_ref.photometric_loss_vjp`; bits and errors are those of `photometric_loss`."""
    check_float32_images(image, target, mask)
    gradient = new_floats(*image.shape)
    return PhotometricLoss(*_measure(image, target, mask, ssim_weight, gradient)), gradient


def _measure(
    image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, gradient: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Loss, L1 and SSIM; writes the gradient, where there is memory for it."""
    values = extension.get_extension().photometric_loss(
        image.detach().contiguous(),
        target.contiguous(),
        None if mask is None else mask.contiguous(),
        ssim_weight,
        gradient,
    )
    loss, l1, ssim = (torch.tensor(value, dtype=torch.float32, device="cpu") for value in values)
    return loss, l1, ssim


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float) -> Any:
        gradient = new_floats(*image.shape) if ctx.needs_input_grad[0] else None
        loss, l1, ssim = _measure(image, target, mask, ssim_weight, gradient)
        ctx.mark_non_differentiable(l1, ssim)
        ctx.set_materialize_grads(False)
        ctx.gradient = gradient
        return loss, l1, ssim

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor | None, *_: Any) -> Any:
        if scale is None:
            return None, None, None, None
        # Training adds the loss to others with weight 1: nothing to scale, and nothing to copy.
        gradient = ctx.gradient if float(scale) == 1 else ctx.gradient * scale
        return gradient, None, None, None
