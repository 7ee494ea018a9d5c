"""Which anchors can be seen from a camera, on a GPU (source/cull.cu)."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cuda.launch import CudaProgram, PackedCamera

#: Threads of a block, and anchors of a word: kThreads and kWarp of the source.
THREADS, WARP_SIZE = 256, 32
PROGRAM = CudaProgram(name="cull.cu", headers=("gaussian_math.h", "image_formation.h"))


@torch.no_grad()
def cull(
    positions: Float[Tensor, "n 3"], log_scales: Float[Tensor, "n 6"], camera: Camera, *, program: CudaProgram = PROGRAM
) -> Int64[Tensor, "v"]:
    """As `cpu.cull`, for float32 tensors on a CUDA device. Waits for the device once, for the number of indices. Raises
    ValueError for shapes that do not match, TypeError for other dtypes, CudaUnavailable where the kernels cannot be
    run.
    """
    n = len(positions)
    if positions.shape != (n, 3) or log_scales.shape != (n, 6):
        raise ValueError(
            f"positions {list(positions.shape)} and log_scales {list(log_scales.shape)} must be [n, 3] and [n, 6]"
        )
    if positions.dtype != torch.float32 or log_scales.dtype != torch.float32:
        raise TypeError(f"positions and log_scales must be float32, not {positions.dtype} and {log_scales.dtype}")
    count, grid, block = ctypes.c_longlong(n), (-(-n // THREADS),), (THREADS,)
    marks, counts = (positions.new_empty(-(-n // WARP_SIZE), dtype=torch.int32) for _ in range(2))
    anchors = positions.detach().contiguous(), log_scales.detach().contiguous()
    program.launch("mark_anchors", grid, block, *anchors, PackedCamera.of(camera), count, marks, counts)
    ends = counts.cumsum(0, dtype=torch.int32)
    rows = positions.new_empty(int(ends[-1]) if n else 0, dtype=torch.int64)
    program.launch("write_rows", grid, block, marks, ends, count, rows)
    return rows
