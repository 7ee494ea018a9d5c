"""Arrays in, arrays out: what functions for tensors need for callers with numpy."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from vdgs.errors import check_kind

#: Tensors or arrays: what goes in comes out.
Array = TypeVar("Array", Tensor, np.ndarray)


def in_place(value: Any) -> Tensor:
    """A tensor, or an array as one that shares its memory."""
    return torch.from_numpy(value) if isinstance(value, np.ndarray) else value


def as_tensor(name: str, value: Any) -> Tensor:
    """A tensor, or a copy of an array as one, in the precision that it came in. Raises TypeError for anything else."""
    check_kind(name, value, Tensor, np.ndarray)
    return torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value


def to_torch(value: Any) -> Tensor:
    """A tensor, or an array as one: float64 arrays become float32, as numpy makes float64 unasked."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, np.float32 if value.dtype == np.float64 else value.dtype))
    return value


def like(given: Any, value: Any) -> Any:
    """A result in the kind that was given: arrays for arrays."""
    if not isinstance(given, np.ndarray):
        return value
    if isinstance(value, Tensor):
        return value.detach().cpu().numpy()
    if isinstance(value, dict):
        return {name: like(given, each) for name, each in value.items()}
    if isinstance(value, tuple):
        items = [like(given, each) for each in value]
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
    return value
