"""What the C++ kernels ask of their arguments: float32, contiguous, in main memory."""

from __future__ import annotations

import torch
from torch import Tensor

from vdgs.geometry.camera import Camera


def contiguous(tensor: Tensor) -> Tensor:
    """The same numbers as the kernels read them, differentiably; the tensor itself where it is so already."""
    return tensor.to(device="cpu", dtype=torch.float32).contiguous()


def new_floats(*shape: int) -> Tensor:
    """What a kernel fills, whatever torch's default dtype and device are."""
    return torch.empty(shape, dtype=torch.float32, device="cpu")


def check_outputs(**arguments: Tensor) -> None:
    """Raise TypeError unless a kernel can write into each: of another dtype or strided, its binding would be handed a
    copy, and the results would be lost."""
    for name, tensor in arguments.items():
        if tensor.dtype != torch.float32 or not tensor.is_contiguous():
            raise TypeError(f"{name} must be float32 and contiguous, not {tensor.dtype} of strides {tensor.stride()}")


def packed_camera(camera: Camera) -> Tensor:
    """The camera as the kernels read it, [23] float32."""
    return torch.from_numpy(camera.packed)
