"""What compiled kernels take of a card: registers, shared memory, and memory where registers did not do, by `ptxas`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from vdgs.kernels.cuda.launch import COMPILE_OPTIONS, read_header, read_source
from vdgs.kernels.cuda.nvrtc import CompileTarget, Nvrtc, get_nvrtc


@dataclass(frozen=True)
class Resources:
    """What a kernel takes: registers of each thread, bytes of shared memory of each block, bytes that are spilled."""

    kernel: str
    registers: int
    shared_bytes: int
    spilled_bytes: int


def resources_of(
    name: str, target: CompileTarget, headers: Sequence[str] = (), compiler: Nvrtc | None = None
) -> tuple[Resources, ...]:
    """Of each kernel of a source of `vdgs.kernels.cuda`, compiled for a target (machine code, not PTX).

    Raises CompileError, CudaUnavailable.
    """
    texts = {title: read_header(title) for title in headers}
    options = (*COMPILE_OPTIONS, "--ptxas-options=-v")
    _, log = (compiler or get_nvrtc()).compile_with_log(name, read_source(name), texts, target, options)
    return tuple(
        _read(kernel, text) for kernel, text in re.findall(r"entry function '(\w+)'(.*?)Compile time", log, re.S)
    )


def _read(kernel: str, text: str) -> Resources:
    def number(pattern: str) -> int:
        found = re.search(pattern, text)
        return int(found[1]) if found else 0

    spilled = number(r"(\d+) bytes spill stores") + number(r"(\d+) bytes spill loads")
    return Resources(kernel, number(r"Used (\d+) registers"), number(r"(\d+) bytes smem"), spilled)
