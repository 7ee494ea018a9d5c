"""Which anchors can be seen from a camera, in C++."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import check_row_shapes, contiguous, packed_camera


def cull(positions: Float[Tensor, "n 3"], log_scales: Float[Tensor, "n 6"], camera: Camera) -> Int64[Tensor, "v"]:
    """Indices, ascending, of the anchors that may touch the image: the bound of
    `vdgs.kernels.torch_ref.cull.cull`, of which this is the float32 twin.

    The scales are read only where the centre does not already lie on the image. Raises ValueError
    where the shapes do not belong together.
    """
    check_row_shapes(positions.shape[0], positions=(positions, 3), log_scales=(log_scales, 6))
    visible = extension.get_extension().cull(
        contiguous(positions.detach()), contiguous(log_scales.detach()), packed_camera(camera)
    )
    indices = torch.empty(visible.count, dtype=torch.int64)
    visible.write(indices)
    return indices
