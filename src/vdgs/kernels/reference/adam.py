"""Adam for the rows that a view has touched (visible-only Adam, as in Taming-3DGS).

A row that is not given keeps its parameters *and* its moments: an anchor that no camera of the step saw
does not drift on old momentum. The bias correction counts the global step.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor


class StepFactors(NamedTuple):
    """What a step needs of its settings: parameter -= rate · m / (sqrt(v) · root + epsilon)."""

    rate: float
    root: float
    beta1: float
    beta2: float
    epsilon: float


@torch.no_grad()
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
    """One step of Adam (Kingma and Ba 2015, algorithm 1) on the given rows, in place.

    `gradient` holds one row for each of `rows`, which ascend without repetition; None means all rows.
    `step` counts from 1. Returns whether every gradient was finite; if not, nothing is changed.

    Raises IndexError for a row outside the parameter, ValueError for rows that do not ascend, shapes that
    do not match or settings out of range, TypeError for other types of elements: before any change.
    """
    factors = check_step(learning_rate, step, beta1, beta2, epsilon)
    check_rows(parameter, rows, gradient, first_moment, second_moment)
    if not bool(torch.isfinite(gradient).all()):
        return False
    index = slice(None) if rows is None else rows
    first = beta1 * first_moment[index] + (1 - beta1) * gradient
    second = beta2 * second_moment[index] + (1 - beta2) * gradient**2
    first_moment[index] = first
    second_moment[index] = second
    parameter[index] -= factors.rate * first / (second.sqrt() * factors.root + epsilon)
    return True


def check_step(
    learning_rate: float, step: int, beta1: float = 0.9, beta2: float = 0.999, epsilon: float = 1e-15
) -> StepFactors:
    """The factors of a step with both bias corrections folded in, or ValueError."""
    if step < 1:
        raise ValueError(f"step counts from 1, got {step}")
    if not (0 <= beta1 < 1 and 0 <= beta2 < 1):
        raise ValueError(f"beta1 and beta2 must lie in [0, 1), got {beta1} and {beta2}")
    if not (math.isfinite(learning_rate) and learning_rate >= 0 and epsilon > 0):
        raise ValueError(f"learning_rate must be finite and not negative, epsilon positive: {learning_rate}, {epsilon}")
    return StepFactors(learning_rate / (1 - beta1**step), 1 / math.sqrt(1 - beta2**step), beta1, beta2, epsilon)


def check_rows(
    parameter: Tensor, rows: Tensor | None, gradient: Tensor, first_moment: Tensor, second_moment: Tensor
) -> None:
    """Raise a clear error unless the tensors fit together."""
    state = {"parameter": parameter, "first_moment": first_moment, "second_moment": second_moment}
    for name, tensor in {**state, "gradient": gradient}.items():
        if not tensor.is_floating_point() or tensor.dtype != parameter.dtype:
            raise TypeError(f"{name} must be floating and of the parameter's type, not {tensor.dtype}")
    for name, tensor in state.items():
        if tensor.ndim == 0 or tensor.shape != parameter.shape:
            raise ValueError(f"{name} is {list(tensor.shape)} but the parameter {list(parameter.shape)}")
    if rows is not None:
        check_indices(rows, parameter.shape[0])
    count = parameter.shape[0] if rows is None else rows.shape[0]
    if gradient.shape != (count, *parameter.shape[1:]):
        expected = [count, *parameter.shape[1:]]
        raise ValueError(f"gradient is {list(gradient.shape)}, not {expected}: one row for each of the rows")


def check_indices(rows: Tensor, count: int) -> None:
    """Raise a clear error unless `rows` are int64 [v], ascend without repetition and lie in 0 .. count - 1."""
    if rows.dtype != torch.int64:
        raise TypeError(f"rows must be int64, not {rows.dtype}")
    if rows.ndim != 1:
        raise ValueError(f"rows must be [v], not {list(rows.shape)}")
    if not len(rows):
        return
    if not bool((rows[1:] > rows[:-1]).all()):
        raise ValueError("rows must ascend without repetition")
    if int(rows[0]) < 0 or int(rows[-1]) >= count:
        raise IndexError(f"rows reach from {int(rows[0])} to {int(rows[-1])}, of {count}")
