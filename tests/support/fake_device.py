"""A card that is not there: tensors whose arithmetic is done on the CPU while they say that they are on `cuda`.

Torch's own fake tensors cannot do this here: without a CUDA build, autograd on a fake `cuda` tensor ends the process.
So the device is a mark on the memory of a tensor. Code under test reads it as `tensor.device`; every operation, those
of the backward pass included, is checked as a card would check it: all tensors but single numbers on one device.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes

import vdgs

CARD = torch.device("cuda")
ATEN = torch.ops.aten
#: What may take tensors from one device to another.
CROSSING = {ATEN.copy_.default, ATEN._to_copy.default}
#: From here on it is autograd that calls operations.
BACKWARD = {torch.autograd.grad, torch.autograd.backward, Tensor.backward}
#: Operations that wait for the card, most of them to know how large their result is.
WAITING = {
    ATEN._local_scalar_dense.default, ATEN.nonzero.default, ATEN._unique2.default, ATEN.unique_dim.default,
    ATEN.unique_consecutive.default, ATEN.masked_select.default, ATEN.bincount.default, ATEN.equal.default,
    ATEN.is_nonzero.default, ATEN.repeat_interleave.Tensor,
}  # fmt: skip
#: These wait where they are given a mask in place of indices.
INDEXING = {ATEN.index.Tensor, ATEN.index_put.default, ATEN.index_put_.default}
#: How a tensor of the card comes from numbers of Python.
FROM_NUMBERS = {torch.tensor, torch.as_tensor, torch.asarray}
#: What is looked at although no device is named; what a tensor is asked for its device by.
DEVICE = Tensor.device.__get__
ASKED = {DEVICE, Tensor.numpy, Tensor.cpu, Tensor.to, Tensor.new_tensor, Tensor.pin_memory, Tensor.tolist}
#: Of the package that is tested.
PACKAGE = str(Path(vdgs.__file__).parent)


class Memory:
    """Which memory is the card's. What it holds is kept, so that no address is given out twice."""

    #: That of the pretended card, while there is one.
    current: Memory | None = None

    def __init__(self, waits: Counter[str]) -> None:
        self.waits = waits
        self._held: dict[int, Any] = {}
        self._neutral: dict[int, Any] = {}
        #: Whether the operation that runs was called from Python, and not by autograd.
        self.told = False

    def mark(self, tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        self._held[storage._cdata] = storage
        return tensor

    def wait(self, what: str) -> None:
        """Count that what Python does waits for the card, by where it is written."""
        frame = sys._getframe(1)
        while frame.f_back is not None and not frame.f_code.co_filename.startswith(PACKAGE):
            frame = frame.f_back
        place = Path(frame.f_code.co_filename)
        where = f"{place.relative_to(PACKAGE)}: {frame.f_code.co_name}" if place.is_relative_to(PACKAGE) else "a test"
        self.waits[f"{where}: {what}"] += 1

    def mark_neutral(self, tensor: Tensor) -> None:
        """Autograd made it on the device of its gradients, which it takes for the CPU."""
        storage = tensor.untyped_storage()
        self._neutral[storage._cdata] = storage

    def holds(self, tensor: Tensor) -> bool:
        return tensor.untyped_storage()._cdata in self._held

    def is_elsewhere(self, tensor: Tensor) -> bool:
        return not self.holds(tensor) and tensor.untyped_storage()._cdata not in self._neutral


def tensors_in(values: Any) -> list[Tensor]:
    """Those among what an operation is given or makes. (Torch's own `tree_flatten` takes as long as the operation.)"""
    found = list[Tensor]()
    _collect((values,), found)
    return found


def _collect(values: Iterable[Any], found: list[Tensor]) -> None:
    for each in values:
        if isinstance(each, Tensor):
            found.append(each)
        elif isinstance(each, (list, tuple)):
            _collect(each, found)
        elif isinstance(each, dict):
            _collect(each.values(), found)


class Checked(TorchDispatchMode):
    """Every operation: its tensors are on one device, and so is what comes of them."""

    def __init__(self, memory: Memory) -> None:
        super().__init__()
        self.memory = memory

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled: what keeps the compiler out takes longer than most operations

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = tensors_in((args, kwargs))
        there = any(map(self.memory.holds, given))
        if there and func not in CROSSING:
            for tensor in given:
                if self.memory.is_elsewhere(tensor) and tensor.dim():
                    raise RuntimeError(f"{func}: tensors on cuda and of shape {list(tensor.shape)} on the CPU")
        masked = func in INDEXING and any(t.dtype in (torch.bool, torch.uint8) for t in tensors_in(args[1]))
        if there and (func in WAITING or masked):
            self.memory.wait("a mask as index" if masked else func.name().removeprefix("aten::"))
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
            return self._call(func, args, kwargs or {})
        finally:
            self.memory.told = False

    def _call(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        if "device" not in kwargs and func not in ASKED:
            return func(*args, **kwargs)
        if func == DEVICE:
            return CARD if self.memory.holds(args[0]) else func(*args)
        if func is Tensor.numpy and self.memory.holds(args[0]):
            raise TypeError("can't convert a cuda tensor to numpy: use cpu() first")
        if func is Tensor.cpu:
            return self._copied(args[0], None) if self.memory.holds(args[0]) else args[0]
        if func is Tensor.to:
            return self._to(*args, **kwargs)
        if func is Tensor.new_tensor:
            made = torch.tensor(*args[1:], dtype=kwargs.get("dtype", args[0].dtype))
            if not self.memory.holds(args[0]):
                return made
            self.memory.wait("new_tensor")
            return self.memory.mark(made)
        if func is Tensor.pin_memory:
            return args[0]
        if func is Tensor.tolist and self.memory.holds(args[0]):
            self.memory.wait("tolist")
        device = kwargs.get("device")
        if (
            device is not None and func is torch.as_tensor and isinstance(args[0], Tensor)
        ):  # a copy, if it lies elsewhere
            return self._to(args[0], **kwargs)
        if device is not None and torch.device(device).type == "cuda" and func in FROM_NUMBERS:
            self.memory.wait(func.__name__)
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
            return self._copied(made, CARD if there else None, bool(named.get("non_blocking")))
        return self.memory.mark(made) if there else made

    def _copied(self, tensor: Tensor, device: torch.device | None, without_waiting: bool = False) -> Tensor:
        """A differentiable copy of a tensor on the card or, with None, in main memory."""
        if device is None or not without_waiting:
            self.memory.wait("to the card" if device else "to main memory")
        copy: Tensor = _Crossing.apply(tensor, self.memory, device is not None)
        return copy


class _Crossing(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, memory: Memory, to_card: bool) -> Tensor:
        ctx.memory, ctx.to_card = memory, to_card
        copy = (
            torch.from_numpy(tensor.detach().numpy().copy())
            if tensor.numel()
            else torch.empty(tensor.shape, dtype=tensor.dtype)
        )
        return memory.mark(copy) if to_card else copy

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        copy = torch.from_numpy(gradient.numpy().copy())
        return copy if ctx.to_card else ctx.memory.mark(copy), None, None


@contextmanager
def pretended_card() -> Iterator[Counter[str]]:
    """Inside, `cuda` is a device like any other. Gives how often Python waited for it, by place and operation."""
    waits = Counter[str]()
    Memory.current = memory = Memory(waits)
    free_and_total = torch.cuda.mem_get_info
    torch.cuda.mem_get_info = lambda device=None: (10**10, 10**10)
    try:
        with Told(memory), Checked(memory):
            yield waits
    finally:
        Memory.current = None
        torch.cuda.mem_get_info = free_and_total


def unseen(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that stands in for compiled code: how it computes is not looked at, what it makes is on the card."""

    @wraps(function)
    def run(*args: Any) -> Any:
        memory = Memory.current
        if memory is None:
            return function(*args)
        if any(memory.is_elsewhere(tensor) for tensor in tensors_in(args)):
            raise RuntimeError(f"{function.__name__}: a tensor is not on cuda")
        with torch._C.DisableTorchFunction(), _disable_current_modes():
            made = function(*args)
        for tensor in tensors_in(made):
            memory.mark(tensor)
        return made

    return run
