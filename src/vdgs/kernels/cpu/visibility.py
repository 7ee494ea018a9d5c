"""How many cameras see each point, in C++: blocks of neighboring points against frusta."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import new_floats
from vdgs.kernels.cpu.cells import morton_order
from vdgs.kernels.torch_ref.visibility import check_points

#: From this many cameras on it pays to sort the points, so that whole blocks of them are decided at once.
SORT_FROM_CAMERAS = 8


def count_visibility(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Int32[Tensor, "n"]:
    """As `torch_ref.count_visibility`, exactly: float64 decides what float32 cannot. O(n) memory; a block of 512
    neighbors inside or outside a frustum costs one test."""
    check_points(points)
    count = torch.zeros(points.shape[0], dtype=torch.int32, device="cpu")
    if len(cameras) == 0 or points.shape[0] == 0:
        return count
    packed = np.stack([camera.packed_float64 for camera in cameras])
    points = points.detach().contiguous()
    if len(cameras) < SORT_FROM_CAMERAS:
        extension.get_extension().count_visibility(points, packed, count)
    else:
        order = morton_order(torch.nan_to_num(points, posinf=0.0, neginf=0.0))
        sorted_count = torch.empty_like(count)
        extension.get_extension().count_visibility(points[order], packed, sorted_count)
        count[order] = sorted_count
    return count


def fade_factors(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], least: int, margin: float
) -> Float[Tensor, " n"]:
    """As `torch_ref.fade_factors`, to 5e-5, and 1 wherever `least` cameras hold a point. Same bits for any number of
    threads. O(n) memory; a block of 512 neighbors that a camera does not reach costs one test."""
    check_points(points)
    if least <= 0 or len(cameras) < least:
        return torch.full(points.shape[:1], float(least <= 0), dtype=torch.float32, device="cpu")
    packed = np.stack([camera.packed_float64 for camera in cameras])
    factors = new_floats(points.shape[0])
    extension.get_extension().fade_factors(points.detach().contiguous(), packed, least, margin, factors)
    return factors


def mark_visible(points: Float[Tensor, "n 3"], camera: Camera) -> Bool[Tensor, "n"]:
    """Which points one camera sees."""
    return count_visibility(points, [camera]) > 0
