"""A stand-in for the CUDA driver that runs a kernel's own text on the processor (cuda_on_host.h)."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import torch

from vdgs.kernels.cuda import launch, nvrtc
from vdgs.kernels.cuda.driver import GridSize
from vdgs.kernels.cuda.launch import read_source
from vdgs.kernels.cuda.nvrtc import CudaUnavailable, Nvrtc

HERE = Path(__file__).parent
SHARED = Path(launch.__file__).parents[1] / "shared"
#: Orders in which threads and warps take turns: forwards, backwards, and two shuffles.
ORDERS = (0, 1, 2, 3)


def host_compiler() -> str | None:
    """A C++ compiler of this machine, if there is one."""
    return next(filter(None, map(shutil.which, filter(None, (os.environ.get("CXX"), "c++", "g++", "clang++")))), None)


def build_on_host(source: str, folder: Path, text: str | None = None, counted: bool = False) -> ctypes.CDLL:
    """A source of vdgs.kernels.cuda as a library for the processor; `host_NAME` runs one thread of a kernel. The
    library is kept in the folder, where the same source is found again.

    `text` is compiled instead of the source's own. `counted`: what it reads and writes can be counted
    (cuda_traffic.py).
    """
    text = text or read_source(source)
    library = folder / f"{sha256(text.encode()).hexdigest()}{'-counted' if counted else ''}.so"
    if not library.exists():
        with TemporaryDirectory(dir=folder) as own:
            _build(text, Path(own), counted).rename(library)
    return ctypes.CDLL(str(library))


def _build(text: str, folder: Path, counted: bool) -> Path:
    kernels = re.findall(r'extern "C" __global__ void(?: __launch_bounds__\([\w, ]+\))?\s+(\w+)\(', text)
    assert kernels, "no kernel in the source"
    exported = "\n".join(f"HOST_KERNEL({name})" for name in kernels)
    (folder / "host.cpp").write_text(f'#include "cuda_on_host.h"\n{text}\n{exported}\n')
    library, built = folder / "host.so", folder / "host.o"
    # Fibers jump between stacks, which fortified longjmp takes for an attack. Before every access to memory the thread
    # sanitizer calls a function; its own library, which is not asked for when linking, has other ones.
    watched = ["-fsanitize=thread"] if counted else []
    _run_compiler(*watched, "-I", str(HERE), "-I", str(SHARED), "-c", str(folder / "host.cpp"), "-o", str(built))
    counting = [str(HERE / "cuda_traffic.cpp")] if counted else []
    _run_compiler("-shared", str(built), *counting, "-o", str(library))
    return library


def _run_compiler(*options: str) -> None:
    command = [str(host_compiler()), "-std=c++17", "-O1", "-U_FORTIFY_SOURCE", "-fPIC", *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


class Stuck(Exception):
    """A kernel that a GPU may not survive."""


class HostDriver:
    """`vdgs.kernels.cuda.driver.Driver` on tensors in main memory, whatever device they say that they are on."""

    def __init__(self, library: ctypes.CDLL, order: int = 0, device_type: str = "cpu"):
        self._library, self.order, self.device_type = library, order, device_type
        #: Modules loaded and kernels launched: (name, grid, block).
        self.loaded: list[bytes] = []
        self.launched: list[tuple[str, GridSize, GridSize]] = []
        self._names: dict[int, str] = {}

    def capability(self, device: torch.device) -> tuple[int, int]:
        return 8, 6

    def load(self, code: bytes, device: torch.device) -> int:
        self.loaded.append(code)
        return len(self.loaded)

    def function(self, module: int, name: str) -> int:
        address = ctypes.cast(getattr(self._library, f"host_{name}"), ctypes.c_void_p).value
        assert address is not None
        self._names[address] = name
        return address

    def launch(self, function: int, grid: GridSize, block: GridSize, device: torch.device, arguments: Any) -> None:
        self.launched.append((self._names[function], grid, block))
        whole = self._library.host_launch(
            ctypes.c_void_p(function), (ctypes.c_uint * 3)(*grid), (ctypes.c_uint * 3)(*block), arguments,
            ctypes.c_uint(self.order),
        )  # fmt: skip
        if not whole:
            raise Stuck("threads of a block wait for others that never come")


try:
    COMPILER: Nvrtc | None = nvrtc.get_nvrtc()
except CudaUnavailable:
    COMPILER = None


needs_nvrtc = pytest.mark.skipif(COMPILER is None, reason="NVRTC is not installed: pip install nvidia-cuda-nvrtc")
needs_a_compiler = pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler")
