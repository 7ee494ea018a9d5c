"""Copies from main memory to a GPU that do not wait for it, as `tensor.to`, `torch.tensor(…, device=…)` and
`new_tensor` do. On the CPU they make no difference."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def to_like(values: Any, like: Tensor) -> Tensor:
    """A few numbers (an array, or a sequence of floats) on the device of a tensor and in its type."""
    tensor = values if isinstance(values, Tensor) else torch.as_tensor(values, dtype=torch.float64)
    return tensor.to(like.device, like.dtype, non_blocking=True)


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A large tensor of main memory on a device. The copy to a card is made from pinned memory, while both go on."""
    if device.type != "cuda" or tensor.device.type != "cpu":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def is_host(tensor: Tensor) -> bool:
    """Whether reading its numbers is free. Reading from a GPU waits for it, so arguments there are not validated."""
    return tensor.device.type == "cpu"
