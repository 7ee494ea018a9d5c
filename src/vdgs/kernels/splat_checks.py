"""What every rasteriser asks of its arguments."""

from __future__ import annotations

import torch
from torch import Tensor

#: The largest picture side: tiles are numbered with 16 bits.
MAX_IMAGE_SIDE_PX = 16 * 32767


def check_splats(tensors: tuple[Tensor, ...], width: int, height: int, device_type: str | None = None) -> None:
    """Raise a clear error unless these are means_px, conics, colours, opacities, depths and a background, float32 (and
    on a kind of device, if one is named), and the sides those of a picture that can be drawn."""
    for name, side in (("width", width), ("height", height)):
        if not 1 <= side <= MAX_IMAGE_SIDE_PX:
            raise ValueError(f"{name} must be from 1 to {MAX_IMAGE_SIDE_PX} pixels, not {side}")
    n = len(tensors[0]) if tensors[0].dim() else 0
    shapes = ((n, 2), (n, 3), (n, 3), (n,), (n,), (3,))
    names = ("means_px", "conics", "colors", "opacities", "depths", "background")
    for name, tensor, shape in zip(names, tensors, shapes, strict=True):
        if tensor.dtype != torch.float32 or device_type not in (None, tensor.device.type):
            where = {None: "", "cpu": " on the CPU"}.get(device_type, f" on {device_type}")
            raise TypeError(f"{name} must be float32{where}, not {tensor.dtype} on {tensor.device}")
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")
