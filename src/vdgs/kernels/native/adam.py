"""Adam on rows in C++: bound by memory, threaded."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.kernels.native import module
from vdgs.kernels.reference.adam import check_rows, check_step


def adam_rows(
    parameter: Float[Tensor, "n *rest"],
    rows: Int64[Tensor, "v"] | None,
    gradient: Float[Tensor, "v *rest"],
    first_moment: Float[Tensor, "n *rest"],
    second_moment: Float[Tensor, "n *rest"],
    *,
    learning_rate: float,
    step: int,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> bool:
    """As `reference.adam.adam_rows`, for contiguous float32 parameters and moments.

    Raises ValueError also where one of those is not contiguous. Same bits for any number of threads.
    """
    factors = check_step(learning_rate, step, beta1, beta2, epsilon)
    check_rows(parameter, rows, gradient, first_moment, second_moment)
    if parameter.dtype != torch.float32:
        raise TypeError(f"parameter must be float32, not {parameter.dtype}")
    state = (parameter, first_moment, second_moment)
    if not all(tensor.is_contiguous() for tensor in state):
        raise ValueError("parameter, first_moment and second_moment must be contiguous")
    if gradient.numel() == 0:
        return True
    flat, first, second = (tensor.detach().view(tensor.shape[0], -1) for tensor in state)
    packed = gradient.detach().contiguous().view(gradient.shape[0], -1)
    chosen = None if rows is None else rows.contiguous()
    finite: bool = module.native().adam_rows(flat, chosen, packed, first, second, *factors)
    if finite:
        # What autograd has saved of these no longer holds their values.
        torch.autograd.graph.increment_version(state)
    return finite
