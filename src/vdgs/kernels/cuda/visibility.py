"""Which points cameras see, on a GPU (source/visibility.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cuda.launch import CudaProgram
from vdgs.kernels.torch_ref import visibility as torch_visibility
from vdgs.kernels.torch_ref.visibility import check_points

#: Threads of a block, and numbers of a camera: kThreads and kNumbers of the source.
THREADS, NUMBERS = 256, 20
PROGRAM = CudaProgram(name="visibility.cu")


class _Frustum(ctypes.Structure):
    """`Frustum` of the source."""

    _fields_ = (("of", NUMBERS * ctypes.c_double),)


def count_visibility(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], *, program: CudaProgram = PROGRAM
) -> Int32[Tensor, "n"]:
    """As `torch_ref.count_visibility`, for points on a CUDA device, all cameras in one launch (points in float64: by
    torch). Raises CudaUnavailable where the kernel cannot be run."""
    check_points(points)
    if points.dtype != torch.float32 or not cameras:
        return torch_visibility.count_visibility(points, cameras)
    frusta = torch.from_numpy(np.stack([camera.packed_float64 for camera in cameras]))
    views = points.new_empty(len(points), dtype=torch.int32)
    program.launch(
        "count_visibility", (-(-len(points) // THREADS),), (THREADS,), points.detach().contiguous(),
        ctypes.c_longlong(len(points)), frusta.to(points.device, non_blocking=True), ctypes.c_int(len(cameras)), views,
    )  # fmt: skip
    return views


def mark_visible(points: Float[Tensor, "n 3"], camera: Camera, *, program: CudaProgram = PROGRAM) -> Bool[Tensor, "n"]:
    """As `torch_ref.mark_visible`, for points on a CUDA device (float64 points: by torch)."""
    check_points(points)
    if points.dtype != torch.float32:
        return torch_visibility.mark_visible(points, camera)
    seen = points.new_empty(len(points), dtype=torch.bool)
    frustum = _Frustum((NUMBERS * ctypes.c_double)(*camera.packed_float64))
    program.launch(
        "mark_visible", (-(-len(points) // THREADS),), (THREADS,), points.detach().contiguous(),
        ctypes.c_longlong(len(points)), frustum, seen,
    )  # fmt: skip
    return seen
