"""Photometric loss on a GPU: L1 and SSIM with their gradient (source/loss.cu)."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vdgs.kernels.autograd import once_differentiable
from vdgs.kernels.cuda.launch import CudaProgram
from vdgs.kernels.kernel_types import PhotometricLoss
from vdgs.kernels.torch_ref.loss import check_float32_images

#: Side of the tile that one block of threads does: kTile of the source.
TILE_PX = 16
PROGRAM = CudaProgram(name="loss.cu")


def photometric_loss(
    image: Float[Tensor, "h w 3"],
    target: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"] | None = None,
    *,
    ssim_weight: float = 0.2,
    program: CudaProgram = PROGRAM,
) -> PhotometricLoss:
    """As `torch_ref.photometric_loss`, for float32 images on a CUDA device, without waiting for it. Differentiable
    once, deterministic. The gradient is computed with the loss and takes 36 bytes a pixel until then. Raises TypeError
    for tensors elsewhere, ValueError for several devices, CudaUnavailable where the kernel cannot be run."""
    check_float32_images(image, target, mask)
    return PhotometricLoss(*_Photometric.apply(image, target, mask, ssim_weight, program))


def photometric_loss_vjp(
    image: Float[Tensor, "h w 3"],
    target: UInt8[Tensor, "h w 3"],
    mask: UInt8[Tensor, "h w"] | None = None,
    *,
    ssim_weight: float = 0.2,
    program: CudaProgram = PROGRAM,
) -> tuple[PhotometricLoss, Float[Tensor, "h w 3"]]:
    """As `torch_ref.photometric_loss_vjp`; waits, bits and errors are those of `photometric_loss`. (Autograd goes
    backward in a thread of its own: on a card that takes longer than the kernels.)"""
    check_float32_images(image, target, mask)
    *values, gradient = _run(_pictures(image, target, mask), ssim_weight, True, program)
    assert gradient is not None
    return PhotometricLoss(*values), gradient


def _pictures(*tensors: Tensor | None) -> list[Tensor | None]:
    return [None if tensor is None else tensor.detach().contiguous() for tensor in tensors]


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, program: CudaProgram
    ) -> tuple[Tensor, ...]:
        pictures, with_gradient = _pictures(image, target, mask), ctx.needs_input_grad[0]
        loss, l1, ssim, ctx.gradient = _run(pictures, ssim_weight, with_gradient, program)
        ctx.mark_non_differentiable(l1, ssim)
        ctx.set_materialize_grads(False)
        return loss, l1, ssim

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, scale: Tensor | None, *_: Any) -> tuple[Tensor | None, ...]:
        # A product even with 1: to look at the number would wait for the device.
        return None if scale is None else ctx.gradient * scale, None, None, None, None


def _run(
    images: list[Tensor | None], ssim_weight: float, with_gradient: bool, program: CudaProgram
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """Loss, L1, SSIM (scalars) and the gradient of the loss, for contiguous image, target and mask."""
    image, _, mask = images
    assert image is not None
    height, width, _ = image.shape
    size = ctypes.c_int(height), ctypes.c_int(width)
    grid, block = (-(-width // TILE_PX), -(-height // TILE_PX)), (TILE_PX, TILE_PX)
    tiles, weight = grid[0] * grid[1], ctypes.c_float(ssim_weight)

    slopes = image.new_empty(3, height, width, 3) if with_gradient else None
    sums = image.new_empty(tiles, 2, dtype=torch.float64)
    program.launch("photometric_forward", grid, block, *images, *size, slopes, sums)
    kept = image.new_full((1,), height * width, dtype=torch.int64) if mask is None else (mask != 0).sum()
    loss, l1, ssim = (image.new_empty(()) for _ in range(3))
    program.launch("photometric_total", (1,), block, sums, ctypes.c_int(tiles), kept, weight, loss, l1, ssim)
    gradient = torch.empty_like(image) if with_gradient else None
    if gradient is not None:
        program.launch("photometric_backward", grid, block, *images, *size, slopes, kept, weight, gradient)
    return loss, l1, ssim, gradient
