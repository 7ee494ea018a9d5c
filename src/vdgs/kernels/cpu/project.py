"""Projection of 3D Gaussians onto the image, in C++; see `vdgs.kernels.torch_ref.project`."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.autograd import once_differentiable
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import contiguous, packed_camera
from vdgs.kernels.kernel_types import ProjectedGaussians


def project(
    means: Float[Tensor, "m 3"], scales: Float[Tensor, "m 3"], quaternions: Float[Tensor, "m 4"], camera: Camera
) -> ProjectedGaussians:
    """As `torch_ref.project`, in float32 and differentiable once: RuntimeError for second derivatives. Raises
    ValueError for shapes that do not match."""
    check_row_shapes(means.shape[0], means=(means, 3), scales=(scales, 3), quaternions=(quaternions, 4))
    arguments = (contiguous(t) for t in (means, scales, quaternions))
    return ProjectedGaussians(*_Project.apply(*arguments, packed_camera(camera)))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        means, *_, camera = tensors
        m = means.shape[0]
        means_px, conics, depths = means.new_empty(m, 2), means.new_empty(m, 3), means.new_empty(m)
        valid = torch.empty(m, dtype=torch.uint8, device="cpu")
        gaussians = [t.detach() for t in tensors[:3]]
        extension.get_extension().project(*gaussians, camera, means_px, conics, depths, valid)
        ctx.save_for_backward(*tensors)
        visible = valid.view(torch.bool)
        ctx.mark_non_differentiable(visible)
        return means_px, conics, depths, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        means, scales, quaternions, camera = (t.detach() for t in ctx.saved_tensors)
        out = [torch.empty_like(t) for t in (means, scales, quaternions)]
        incoming = [g.contiguous() for g in gradients[:3]]
        extension.get_extension().project_backward(means, scales, quaternions, camera, *incoming, *out)
        return *out, None
