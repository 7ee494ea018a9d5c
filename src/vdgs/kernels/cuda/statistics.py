"""Growth's statistics of one view on a GPU (source/statistics.cu)."""

from __future__ import annotations

import ctypes

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vdgs.kernels.cuda.decode import expand_sources
from vdgs.kernels.cuda.launch import CudaProgram
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.kernels.splat_segments import SplatMask
from vdgs.kernels.torch_ref.statistics import check_inside, check_sources, check_sums_and_splats

#: Threads of a block: kThreads of the source.
THREADS = 256
PROGRAM = CudaProgram(name="statistics.cu")


def add_view_statistics(
    statistics: DensificationStats,
    visible: Int64[Tensor, "v"],
    inside: Bool[Tensor, "v"],
    source: Int32[Tensor, "m"] | SplatMask,
    opacities: Float[Tensor, "m"],
    gradient_px: Float[Tensor, "m 2"],
    width: int,
    height: int,
    *,
    program: CudaProgram = PROGRAM,
) -> None:
    """As `torch_ref.add_view_statistics`, for tensors on a CUDA device; float32, and sums contiguous.

    Deterministic, in one pass, without waiting for the device or checking the sources. Anchors may come in any order;
    splats of one anchor are consecutive. Raises ValueError or TypeError for unsuitable tensors, CudaUnavailable where
    the kernel cannot be run.
    """
    sums, k = statistics.tensors(), statistics.gradient.shape[1]
    sources = expand_sources(source)
    check_sources(sources, visible, k)
    check_inside(inside, visible)
    check_sums_and_splats(statistics, len(sources), opacities, gradient_px)
    for name, tensor in (sums | {"opacities": opacities, "gradient_px": gradient_px}).items():
        if tensor.dtype != torch.float32:
            raise TypeError(f"{name} must be float32, not {tensor.dtype}")
    if sources.dtype != torch.int32:
        raise TypeError(f"source must be int32, not {sources.dtype}")
    m, v = len(sources), len(visible)
    program.launch(
        "add_view", (-(-max(m, v) // THREADS),), (THREADS,), visible.contiguous(), inside.contiguous(),
        ctypes.c_longlong(v), sources.contiguous(), opacities.detach().contiguous(), gradient_px.contiguous(),
        ctypes.c_longlong(m), ctypes.c_int(k), ctypes.c_float(width / 2), ctypes.c_float(height / 2), *sums.values(),
    )  # fmt: skip
