"""A card that is not there: tensors whose arithmetic is done on the CPU while they say that they are on `cuda`.

Torch's own fake tensors cannot do this here: without a CUDA build, autograd on a fake `cuda` tensor ends the process.
So the device is a mark on the memory of a tensor. Code under test reads it as `tensor.device`; every operation, those
of the backward pass included, is checked as a card would check it: all tensors but single numbers on one device.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

CARD = torch.device("cuda")
ATEN = torch.ops.aten
#: What may take tensors from one device to another.
CROSSING = {ATEN.copy_.default, ATEN._to_copy.default}
#: From here on it is autograd that calls operations.
BACKWARD = {torch.autograd.grad, torch.autograd.backward, Tensor.backward}
#: Questions that Python asks of the card, each of which waits for it.
WAITING = {ATEN._local_scalar_dense.default, ATEN.nonzero.default, ATEN._unique2.default}


class Memory:
    """Which memory is the card's. What it holds is kept, so that no address is given out twice."""

    def __init__(self) -> None:
        self._held: dict[int, Any] = {}
        self._neutral: dict[int, Any] = {}
        #: Whether the operation that runs was called from Python, and not by autograd.
        self.told = False

    def mark(self, tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        self._held[storage._cdata] = storage
        return tensor

    def mark_neutral(self, tensor: Tensor) -> None:
        """Autograd made it on the device of its gradients, which it takes for the CPU."""
        storage = tensor.untyped_storage()
        self._neutral[storage._cdata] = storage

    def holds(self, tensor: Tensor) -> bool:
        return tensor.untyped_storage()._cdata in self._held

    def is_elsewhere(self, tensor: Tensor) -> bool:
        return not self.holds(tensor) and tensor.untyped_storage()._cdata not in self._neutral


def tensors_in(values: Any) -> list[Tensor]:
    return [each for each in tree_flatten(values)[0] if isinstance(each, Tensor)]


class Checked(TorchDispatchMode):
    """Every operation: its tensors are on one device, and so is what comes of them."""

    def __init__(self, memory: Memory, waits: Counter[str]) -> None:
        super().__init__()
        self.memory, self.waits = memory, waits

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = tensors_in((args, kwargs))
        there = [tensor for tensor in given if self.memory.holds(tensor)]
        elsewhere = [tensor for tensor in given if tensor.dim() and self.memory.is_elsewhere(tensor)]
        if there and elsewhere and func not in CROSSING:
            raise RuntimeError(f"{func}: tensors on cuda and of shape {list(elsewhere[0].shape)} on the CPU")
        if there and func in WAITING:
            self.waits[str(func)] += 1
        made = func(*args, **(kwargs or {}))
        if there and func is not ATEN.copy_.default:
            for tensor in tensors_in(made):
                self.memory.mark(tensor)
        if not given and not self.memory.told:
            for tensor in tensors_in(made):
                self.memory.mark_neutral(tensor)
        return made


class Told(TorchFunctionMode):
    """What Python code says and asks of devices."""

    def __init__(self, memory: Memory) -> None:
        super().__init__()
        self.memory = memory

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.memory.told = func not in BACKWARD
        try:
            return self._call(func, args, dict(kwargs or {}))
        finally:
            self.memory.told = False

    def _call(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        if func == Tensor.device.__get__:  # a new object each time: never the same
            return CARD if self.memory.holds(args[0]) else func(*args)
        if func is Tensor.numpy and self.memory.holds(args[0]):
            raise TypeError("can't convert a cuda tensor to numpy: use cpu() first")
        if func is Tensor.cpu:
            return args[0].detach().clone() if not self.memory.holds(args[0]) else self._copied(args[0], None)
        if func is Tensor.to:
            return self._to(*args, **kwargs)
        if func is Tensor.new_tensor:
            made = torch.tensor(*args[1:], dtype=kwargs.get("dtype", args[0].dtype))
            return self.memory.mark(made) if self.memory.holds(args[0]) else made
        device = kwargs.get("device")
        if device is not None and torch.device(device).type == "cuda":
            return self.memory.mark(func(*args, **kwargs | {"device": "cpu"}))
        return func(*args, **kwargs)

    def _to(self, tensor: Tensor, *wanted: Any, **named: Any) -> Tensor:
        device: Any = named.get("device")
        dtype = named.get("dtype")
        for each in wanted:
            if isinstance(each, Tensor):
                device, dtype = CARD if self.memory.holds(each) else torch.device("cpu"), each.dtype
            elif isinstance(each, torch.dtype):
                dtype = each
            elif isinstance(each, str | torch.device):
                device = each
        made = tensor if dtype is None else tensor.to(dtype)
        there = self.memory.holds(tensor) if device is None else torch.device(device).type == "cuda"
        if there != self.memory.holds(tensor):
            return self._copied(made, CARD if there else None)
        return self.memory.mark(made) if there else made

    def _copied(self, tensor: Tensor, device: torch.device | None) -> Tensor:
        """A differentiable copy of a tensor on the card or, with None, in main memory."""
        copy: Tensor = _Crossing.apply(tensor, self.memory, device is not None)
        return copy


class _Crossing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, memory: Memory, to_card: bool) -> Tensor:
        ctx.memory, ctx.to_card = memory, to_card
        copy = torch.from_numpy(tensor.detach().numpy().copy()) if tensor.numel() else torch.empty_like(tensor)
        return memory.mark(copy) if to_card else copy

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        copy = torch.from_numpy(gradient.numpy().copy())
        return copy if ctx.to_card else ctx.memory.mark(copy), None, None


@contextmanager
def pretended_card() -> Iterator[Counter[str]]:
    """Inside, `cuda` is a device like any other. Gives how often Python waited for it, by operation."""
    memory, waits = Memory(), Counter[str]()
    with Told(memory), Checked(memory, waits):
        yield waits
