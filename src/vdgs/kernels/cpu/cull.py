"""Which anchors can be seen from a camera, in C++."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import contiguous, packed_camera


def cull(positions: Float[Tensor, "n 3"], log_scales: Float[Tensor, "n 6"], camera: Camera) -> Int64[Tensor, "v"]:
    """As `torch_ref.cull`, in float32; scales are read only where the center lies outside the image. Raises ValueError
    for shapes that do not match."""
    check_row_shapes(positions.shape[0], positions=(positions, 3), log_scales=(log_scales, 6))
    visible = extension.get_extension().cull(
        contiguous(positions.detach()), contiguous(log_scales.detach()), packed_camera(camera)
    )
    indices = torch.empty(visible.count, dtype=torch.int64, device="cpu")
    visible.write(indices)
    return indices
