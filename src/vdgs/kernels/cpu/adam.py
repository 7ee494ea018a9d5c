"""Adam on rows in C++: bound by memory, threaded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.kernels.cpu import extension
from vdgs.kernels.kernel_types import AdamState
from vdgs.kernels.torch_ref.adam import AdamStepFactors, check_rows, check_step


def adam_rows(
    state: AdamState,
    rows: Int64[Tensor, "v"] | None,
    gradient: Float[Tensor, "v *rest"],
    step: int | Int32[Tensor, " v"],
    *,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> bool:
    """As `torch_ref.adam_rows`, for contiguous float32 parameters and moments.

    Raises ValueError also where one of those is not contiguous. Same bits for any number of threads.
    """
    if state.parameter.dtype != torch.float32:  # else one of the others would be told to be of its type
        raise TypeError(f"parameter must be float32, not {state.parameter.dtype}")
    check_rows(state, rows, gradient)
    factors = check_step(state, step, len(gradient), beta1, beta2, epsilon)
    tensors = state[:3]
    if not all(tensor.is_contiguous() for tensor in tensors):
        raise ValueError("parameter, first moment and second moment must be contiguous")
    if gradient.numel() == 0:
        return True
    flat, first, second = (tensor.detach().view(tensor.shape[0], -1) for tensor in tensors)
    packed = gradient.detach().contiguous().view(gradient.shape[0], -1)
    chosen = None if rows is None else rows.contiguous()
    updates = None if isinstance(step, int) else step.contiguous()
    finite: bool = extension.get_extension().adam_rows(
        flat, chosen, packed, first, second, updates, *round_factors(factors)
    )
    if finite:
        # What autograd has saved of these no longer holds their values.
        torch.autograd.graph.increment_version(tensors)
    return finite


def adam_tensors(
    states: Sequence[AdamState],
    gradients: Sequence[Tensor],
    step: int,
    *,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> bool:
    """As `torch_ref.adam_tensors`, by `adam_rows`."""
    each = zip(states, gradients, strict=True)
    finite = [adam_rows(s, None, g, step, beta1=beta1, beta2=beta2, epsilon=epsilon) for s, g in each]
    return all(finite)


def round_factors(factors: AdamStepFactors) -> AdamStepFactors:
    """The same with the tables in float32."""
    return factors._replace(
        step_sizes=factors.step_sizes.astype(np.float32), bias_roots=factors.bias_roots.astype(np.float32)
    )
