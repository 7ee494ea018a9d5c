"""Which build of the C++ kernels runs: one extension module per instruction set, the best one chosen here.

Environment: `VDGS_ISA` (avx512, avx2 or portable) overrides the choice, `VDGS_THREADS` the number of
threads, which by default is the number of cores that this process may use.
"""

from __future__ import annotations

import importlib
import os
from functools import cache
from types import ModuleType
from typing import Any

from vdgs.errors import VdgsError
from vdgs.kernels.thread_count import default_num_threads

#: Every instruction set that the kernels are built for, best first.
INSTRUCTION_SETS = ("avx512", "avx2", "portable")


class NativeUnavailable(VdgsError):
    """The C++ kernels cannot be loaded as asked."""


@cache
def get_extension() -> Any:
    """The module that the kernels of this process use: `VDGS_ISA`, or the best that the processor runs.

    Raises NativeUnavailable if it is not built, or VDGS_ISA names what this processor cannot run.
    """
    wanted = os.environ.get("VDGS_ISA")
    if wanted:
        return load_extension(wanted)
    for name in supported_isas():
        try:
            return load_extension(name)
        except NativeUnavailable:
            if name == "portable":
                raise
    raise AssertionError("every processor supports the portable kernels")


@cache
def load_extension(name: str) -> Any:
    """The module for one instruction set, with the number of threads of this process set.

    Raises NativeUnavailable for an unknown name, an unsupported instruction set, or a missing build.
    """
    if name not in INSTRUCTION_SETS:
        raise NativeUnavailable(
            f"VDGS_ISA: there are no kernels for {name!r}; choose one of {', '.join(INSTRUCTION_SETS)}."
        )
    if name not in supported_isas():
        raise NativeUnavailable(
            f"VDGS_ISA: this processor cannot run {name} kernels; it can run {', '.join(supported_isas())}."
        )
    module: Any = _import(name)
    module.set_threads(default_num_threads())
    return module


@cache
def supported_isas() -> tuple[str, ...]:
    """The instruction sets that this processor can run, best first; asked of the portable build."""
    return tuple(_import("portable").supported())


def active_isa() -> str:
    """The instruction set of the kernels in use: avx512, avx2 or portable."""
    return str(get_extension().isa)


def get_num_threads() -> int:
    """How many threads the kernels use."""
    return int(get_extension().threads())


def set_num_threads(count: int) -> None:
    """Let the kernels use up to `count` threads, the calling one included. Raises ValueError below 1."""
    if count < 1:
        raise ValueError(f"the number of threads must be at least 1, not {count}")
    get_extension().set_threads(count)


def _import(name: str) -> ModuleType:
    try:
        return importlib.import_module(f"vdgs.kernels._native_{name}")
    except ImportError as error:
        raise NativeUnavailable(
            f"The {name} kernels of vdgs are not built ({error}). Build them with `pip install -e .` "
            "in the checkout (a C++17 compiler is needed), or install a released wheel."
        ) from error
