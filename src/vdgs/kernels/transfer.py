"""Numbers on their way from main memory to a card, without waiting for it.

A plain `tensor.to(card)`, `torch.tensor(…, device=card)` or `new_tensor` first waits until the card has done all that
was queued. On the processor nothing of this makes a difference.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def to_like(values: Any, like: Tensor) -> Tensor:
    """A few numbers (an array, or a sequence of floats) on the device of a tensor and in its type."""
    given = values if isinstance(values, Tensor) else torch.as_tensor(values, dtype=torch.float64)
    return given.to(like.device, like.dtype, non_blocking=True)


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A large tensor of main memory on a device. The copy to a card is made from pinned memory, while both go on."""
    if device.type != "cuda" or tensor.device.type != "cpu":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def is_host(tensor: Tensor) -> bool:
    """Whether looking at its numbers costs nothing: to ask a card means to wait for it, so that what is only checked to
    say clearly what is wrong is not checked there."""
    return tensor.device.type == "cpu"
