"""Adam on whole small tensors on a GPU, all of them in one launch (source/adam.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from vdgs.kernels.cuda.launch import CudaProgram, common_device
from vdgs.kernels.kernel_types import AdamState, IsFinite
from vdgs.kernels.torch_ref.adam import check_rows, check_step

#: Threads of a block, and tensors of one launch: kThreads and kTensors of the source.
THREADS, MAX_TENSORS = 256, 32
PROGRAM = CudaProgram(name="adam.cu")


class _Tensors(ctypes.Structure):
    """`Tensors` of the source."""

    _fields_ = (
        *((name, MAX_TENSORS * ctypes.c_void_p) for name in ("parameter", "first", "second", "gradient")),
        ("size", MAX_TENSORS * ctypes.c_int),
        ("rate", MAX_TENSORS * ctypes.c_float),
    )


@torch.no_grad()
def adam_tensors(
    states: Sequence[AdamState],
    gradients: Sequence[Tensor],
    step: int,
    *,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
    program: CudaProgram = PROGRAM,
) -> IsFinite:
    """As `torch_ref.adam_tensors`, for contiguous float32 parameters and moments on a CUDA device, without waiting for
    it. Raises ValueError or TypeError for unsuitable tensors, CudaUnavailable where the kernel cannot be run."""
    if not states:
        return True
    rates, root, known = [], 1.0, dict[tuple[float, float], float]()
    for state, gradient in zip(states, gradients, strict=True):
        if not _fit(state, gradient):
            if state.parameter.dtype != torch.float32:
                raise TypeError(f"parameter must be float32, not {state.parameter.dtype}")
            check_rows(state, None, gradient)
        rate = state.learning_rate, state.lr_boost
        if rate not in known:  # some tensors share one
            factors = check_step(state, step, len(gradient), beta1, beta2, epsilon)
            known[rate], root = float(factors.step_sizes[0]), float(factors.bias_roots[0])
        rates.append(known[rate])
    packed = [gradient.contiguous() for gradient in gradients]
    finite = packed[0].new_empty(len(states), dtype=torch.bool)
    moved = [tensor for state in states for tensor in state[:3]]
    common_device((*moved, *packed, finite), finite.device.type)
    for first in range(0, len(states), MAX_TENSORS):
        some = slice(first, first + MAX_TENSORS)
        table = _table(states[some], packed[some], rates[some])
        settings = (ctypes.c_float(value) for value in (root, beta1, beta2, 1 - beta1, 1 - beta2, epsilon))
        program.launch("adam_tensors", (len(states[some]),), (THREADS,), table, *settings, finite[some])
    torch.autograd.graph.increment_version(moved)
    return finite.all()


def _fit(state: AdamState, gradient: Tensor) -> bool:
    """Whether the tensors are of float32 and one shape; quicker than to say what is wrong."""
    shape, tensors = gradient.shape, (*state[:3], gradient)
    return bool(shape) and all(t.shape == shape and t.dtype == torch.float32 for t in tensors)


def _table(states: Sequence[AdamState], gradients: Sequence[Tensor], rates: Sequence[float]) -> _Tensors:
    table = _Tensors()
    for i, (state, gradient, rate) in enumerate(zip(states, gradients, rates, strict=True)):
        table.parameter[i], table.first[i], table.second[i] = (tensor.data_ptr() for tensor in state[:3])
        table.gradient[i], table.size[i], table.rate[i] = gradient.data_ptr(), gradient.numel(), rate
    return table
