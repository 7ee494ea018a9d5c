"""Bytes that CUDA kernels read and write, counted while their own text runs on the processor (cuda_traffic.cpp)."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from torch import Tensor

from support.cuda_on_host import HostDriver, build_on_host
from vdgs.kernels.cuda.launch import CudaProgram, KernelArgument, read_source


@dataclass(frozen=True)
class Bytes:
    """What passes in one direction, with caches of three kinds: see cuda_traffic.cpp."""

    once: int = 0
    blocks: int = 0
    lanes: int = 0

    def __add__(self, other: Bytes) -> Bytes:
        return Bytes(*(getattr(self, each.name) + getattr(other, each.name) for each in fields(self)))


@dataclass(frozen=True)
class Traffic:
    """Of one argument of a kernel in one launch."""

    launch: int
    kernel: str
    argument: str
    read: Bytes
    written: Bytes


class CountedProgram(CudaProgram):
    """A program whose launches are counted."""

    def __init__(self, program: CudaProgram, folder: Path):
        self._library = build_on_host(folder, counted=True)
        super().__init__(name=program.name, driver=HostDriver(self._library), headers=program.headers)
        self.traffic: list[Traffic] = []
        self._launches = 0

    def launch(self, kernel: str, grid: Sequence[int], block: Sequence[int], *arguments: KernelArgument) -> None:
        named = list(zip(parameters_of(self.name, kernel), arguments, strict=True))
        tensors = [(name, argument) for name, argument in named if isinstance(argument, Tensor) and argument.numel()]
        count, whole = len(tensors), ctypes.c_ulonglong
        begins = (whole * count)(*(tensor.data_ptr() for _, tensor in tensors))
        sizes = (whole * count)(*(tensor.numel() * tensor.element_size() for _, tensor in tensors))
        self._library.traffic_begin(count, begins, sizes)
        super().launch(kernel, grid, block, *arguments)
        found = (whole * (6 * count))()
        self._library.traffic_end(found)
        for i, (name, _) in enumerate(tensors):
            six = found[6 * i : 6 * i + 6]
            self.traffic.append(Traffic(self._launches, kernel, name, Bytes(*six[:3]), Bytes(*six[3:])))
        self._launches += 1


def parameters_of(source: str, kernel: str) -> list[str]:
    """Names of a kernel's parameters, in order."""
    found = re.search(rf"\b{kernel}\((.*?)\)\s*\{{", read_source(source), re.S)
    assert found, f"no {kernel} in {source}"
    return [each.split()[-1].lstrip("*&") for each in found[1].split(",")]


def total(traffic: Iterable[Traffic]) -> tuple[Bytes, Bytes]:
    """Read and written."""
    read, written = Bytes(), Bytes()
    for each in traffic:
        read, written = read + each.read, written + each.written
    return read, written
