"""Copies from main memory to a GPU that do not wait for it, as `tensor.to`, `torch.tensor(…, device=…)` and
`new_tensor` do. On the CPU they make no difference."""

from __future__ import annotations

import threading
import weakref
from collections import Counter
from collections.abc import MutableMapping
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

#: Share of what a card has free that `DeviceCopies` may take.
COPIES_SHARE = 0.1


def to_like(values: Any, like: Tensor) -> Tensor:
    """A few numbers (an array, or a sequence of floats) on the device of a tensor and in its type."""
    tensor = values if isinstance(values, Tensor) else torch.as_tensor(values, dtype=torch.float64, device="cpu")
    return tensor.to(like.device, like.dtype, non_blocking=True)


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A large tensor of main memory on a device. The copy to a card is made from pinned memory, while both go on."""
    if device.type != "cuda" or tensor.device.type != "cpu":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


class DeviceCopies:
    """Copies on cards of large tensors of main memory that are asked for again and again, such as photographs. A copy
    is kept as long as its original is there, while all of a card take at most a share of what it has free when its
    first one comes. They hold what the originals held then: these must not change."""

    def __init__(self) -> None:
        self._kept: MutableMapping[Tensor, dict[torch.device, Tensor]] = WeakIdKeyDictionary()
        self._room = dict[torch.device, int]()
        self._bytes = Counter[torch.device]()
        self._lock = threading.RLock()  # originals are dropped by any thread, at any time

    def part(self, tensor: Tensor, inside: tuple[slice, ...], device: torch.device) -> Tensor:
        """`tensor[inside]` on a device."""
        whole = self._whole(tensor, device) if device.type == "cuda" else None
        return upload(tensor[inside], device) if whole is None else whole[inside]

    def _whole(self, tensor: Tensor, device: torch.device) -> Tensor | None:
        """The copy of all of it; None where there is no room."""
        if (kept := self._kept.get(tensor, {}).get(device)) is not None:
            return kept
        if device not in self._room:
            self._room[device] = int(COPIES_SHARE * torch.cuda.mem_get_info(device)[0])
        if tensor.nbytes + self._bytes[device] > self._room[device]:
            return None
        self._count(device, tensor.nbytes)
        weakref.finalize(tensor, self._count, device, -tensor.nbytes)
        copy = upload(tensor, device)
        self._kept.setdefault(tensor, {})[device] = copy
        return copy

    def _count(self, device: torch.device, change: int) -> None:
        with self._lock:
            self._bytes[device] += change


def is_host(tensor: Tensor) -> bool:
    """Whether reading its numbers is free. Reading from a GPU waits for it, so arguments there are not validated."""
    return tensor.device.type == "cpu"
