"""Sparse Adam (as in Taming-3DGS): only the rows that a view has touched move, others keep parameters and moments.

The bias correction counts the updates of each row: with the global step, a row first seen late would make its first
step (1 - beta1) / sqrt(1 - beta2) = 3.2 times too large. `AdamState.lr_boost` lengthens the first steps of each row.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.kernels.kernel_types import AdamState, IsFinite
from vdgs.kernels.transfer import is_host


class AdamStepFactors(NamedTuple):
    """Factors of parameter -= step_size · m / (sqrt(v) · bias_root + epsilon), for 1, 2, ... updates of a row; the last
    also for more."""

    step_sizes: Float[np.ndarray, " t"]
    bias_roots: Float[np.ndarray, " t"]
    beta1: float
    beta2: float
    epsilon: float


@torch.no_grad()
def adam_rows(
    state: AdamState,
    rows: Int64[Tensor, "v"] | None,
    gradient: Float[Tensor, "v *rest"],
    step: int | Int32[Tensor, " v"],
    *,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> IsFinite:
    """One step of Adam (Kingma and Ba 2015, algorithm 1) on the given rows, in place.

    `gradient` holds one row for each of `rows`, which ascend without repetition; None means all rows.
    `step` counts from 1: for all rows, or for each of them the updates that it has had, this one included.
    Returns whether every gradient was finite (a tensor on a GPU); if not, nothing is changed.

    Raises IndexError for a row outside the parameter, ValueError for rows that do not ascend, shapes that do not match
    or settings out of range, TypeError for other dtypes: before any change. Values on a GPU are not checked.
    """
    check_rows(state, rows, gradient)
    factors = check_step(state, step, len(gradient), beta1, beta2, epsilon)
    finite: Tensor | None = torch.isfinite(gradient).all()
    if is_host(gradient):
        if not bool(finite):
            return False
        finite = None
    index = slice(None) if rows is None else rows
    before = state.first[index], state.second[index], state.parameter[index]
    first = beta1 * before[0] + (1 - beta1) * gradient
    second = beta2 * before[1] + (1 - beta2) * gradient**2
    rate, root = _of_rows(factors, state, step, gradient)
    moved = before[2] - rate * first / (second.sqrt() * root + epsilon)
    for tensor, old, new in zip(
        (state.first, state.second, state.parameter), before, (first, second, moved), strict=True
    ):
        tensor[index] = new if finite is None else torch.where(finite, new, old)
    return True if finite is None else finite


def adam_tensors(
    states: Sequence[AdamState],
    gradients: Sequence[Tensor],
    step: int,
    *,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> IsFinite:
    """`adam_rows` on all rows of each of some small tensors. Returns whether every gradient was finite; a tensor with
    one that is not stays as it is."""
    finite: IsFinite = True
    for state, gradient in zip(states, gradients, strict=True):
        finite = adam_rows(state, None, gradient, step, beta1=beta1, beta2=beta2, epsilon=epsilon) & finite
    return finite


def _of_rows(
    factors: AdamStepFactors, state: AdamState, step: int | Tensor, gradient: Tensor
) -> tuple[float | Tensor, float | Tensor]:
    """Rate and root of each row of the gradient, shaped so that they multiply them; numbers if all share them."""
    if isinstance(step, int):
        return float(factors.step_sizes[0]), float(factors.bias_roots[0])
    # The rate changes with every step, these tables never: so they are on the card but once.
    lacking, roots = bias_correction_tables(factors.beta1, factors.beta2, gradient.device)
    index = (step.long() - 1).clamp(max=len(roots) - 1)
    root = roots[index]
    rate = root.clamp(max=state.lr_boost) * state.learning_rate / lacking[index]
    shape = (-1, *[1] * (gradient.ndim - 1))
    return rate.to(gradient.dtype).reshape(shape), root.to(gradient.dtype).reshape(shape)


@cache
def bias_correction_tables(
    beta1: float, beta2: float, device: torch.device, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """1 - beta1^u and 1 / sqrt(1 - beta2^u) for u = 1, 2, ... updates."""
    first, second = _lacking(beta1, beta2)
    return torch.from_numpy(first).to(device, dtype), torch.from_numpy(1 / np.sqrt(second)).to(device, dtype)


def check_step(
    state: AdamState, step: int | Tensor, count: int, beta1: float, beta2: float, epsilon: float
) -> AdamStepFactors:
    """The factors of a step of `count` rows, for one number of updates, or a tensor with that of each row. Raises
    ValueError or TypeError for settings out of range or an unsuitable tensor."""
    if isinstance(step, int):
        return step_factors(state.learning_rate, step, beta1, beta2, epsilon, state.lr_boost)
    check_updates(step, count, min_updates=1)
    return step_factors(state.learning_rate, None, beta1, beta2, epsilon, state.lr_boost)


def step_factors(
    learning_rate: float,
    updates: int | None,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
    lr_boost: float = 1.0,
) -> AdamStepFactors:
    """The factors after `updates`, or after any number of them (None). Raises ValueError for settings out of range."""
    if not (0 <= beta1 < 1 and 0 <= beta2 < 1):
        raise ValueError(f"beta1 and beta2 must lie in [0, 1), got {beta1} and {beta2}")
    if not (math.isfinite(learning_rate) and learning_rate >= 0 and epsilon > 0):
        raise ValueError(f"learning_rate must be finite and not negative, epsilon positive: {learning_rate}, {epsilon}")
    if updates is None:
        first, second = _lacking(beta1, beta2)
    elif updates < 1:
        raise ValueError(f"step counts from 1, got {updates}")
    else:
        first, second = np.array([1 - beta1**updates]), np.array([1 - beta2**updates])
    if not (math.isfinite(lr_boost) and lr_boost >= 1):
        raise ValueError(f"lr_boost must be finite and at least 1, got {lr_boost}")
    roots = 1 / np.sqrt(second)
    return AdamStepFactors(np.minimum(lr_boost, roots) * learning_rate / first, roots, beta1, beta2, epsilon)


@cache
def _lacking(beta1: float, beta2: float) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """1 - beta^u of both betas for u = 1, 2, ... updates, as far as float32 can tell (some 18 000)."""
    until = max(_updates_until(beta1, 2.0**-54), _updates_until(beta2, 2.0**-25))
    first, second = (np.array([1 - beta**u for u in range(1, until + 1)]) for beta in (beta1, beta2))
    return first, second


def _updates_until(beta: float, small: float) -> int:
    """The least u >= 1 with beta^u <= small."""
    return max(1, math.ceil(math.log(small) / math.log(beta))) if beta > 0 else 1


def check_rows(state: AdamState, rows: Tensor | None, gradient: Tensor) -> None:
    """Raise a clear error unless the tensors fit together."""
    parameter = state.parameter
    named = {"parameter": parameter, "first moment": state.first, "second moment": state.second}
    for name, tensor in {**named, "gradient": gradient}.items():
        if not tensor.is_floating_point() or tensor.dtype != parameter.dtype:
            raise TypeError(
                f"{name} must be floating and of the parameter's type, {parameter.dtype}, not {tensor.dtype}"
            )
    for name, tensor in named.items():
        if tensor.ndim == 0 or tensor.shape != parameter.shape:
            raise ValueError(f"{name} is {list(tensor.shape)} but the parameter {list(parameter.shape)}")
    if rows is not None:
        check_indices(rows, parameter.shape[0])
    count = parameter.shape[0] if rows is None else rows.shape[0]
    if gradient.shape != (count, *parameter.shape[1:]):
        expected = [count, *parameter.shape[1:]]
        raise ValueError(f"gradient is {list(gradient.shape)}, not {expected}: one row for each of the rows")


def check_updates(updates: Tensor, count: int, min_updates: int = 0) -> None:
    """Raise a clear error unless these are `count` numbers of updates, none below `min_updates`."""
    if updates.dtype != torch.int32:
        raise TypeError(f"updates must be int32, not {updates.dtype}")
    if updates.shape != (count,):
        raise ValueError(f"updates must be [{count}], not {list(updates.shape)}")
    if is_host(updates) and count and int(updates.min()) < min_updates:
        raise ValueError(f"updates count from {min_updates}, got {int(updates.min())}")


def check_indices(rows: Tensor, count: int) -> None:
    """Raise a clear error unless `rows` are int64 [v], ascend without repetition and lie in 0 .. count - 1."""
    if rows.dtype != torch.int64:
        raise TypeError(f"rows must be int64, not {rows.dtype}")
    if rows.ndim != 1:
        raise ValueError(f"rows must be [v], not {list(rows.shape)}")
    if not len(rows) or not is_host(rows):
        return
    if not bool((rows[1:] > rows[:-1]).all()):
        raise ValueError("rows must ascend without repetition")
    if int(rows[0]) < 0 or int(rows[-1]) >= count:
        raise IndexError(f"rows reach from {int(rows[0])} to {int(rows[-1])}, of {count}")
