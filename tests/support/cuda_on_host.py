"""A stand-in for the CUDA driver that runs a kernel's own text on the processor (cuda_on_host.h)."""

from __future__ import annotations

import ctypes
import fcntl
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
#: Sources of vdgs.kernels.cuda, all of which become one library: most of the time goes into what they share.
SOURCES = ("adam", "cull", "decode", "loss", "rasterize", "statistics", "visibility")
#: Whatever makes threads wait for each other and for nothing else.
BARRIER = re.compile(r"__(sync(?:threads(?:_and|_or)?|warp))\(\)?")
#: Orders in which threads and warps take turns: forwards, backwards, and two shuffles.
ORDERS = (0, 1, 2, 3)


def host_compiler() -> str | None:
    """A C++ compiler of this machine, if there is one."""
    return next(filter(None, map(shutil.which, filter(None, (os.environ.get("CXX"), "c++", "g++", "clang++")))), None)


def barriers_of(source: str) -> list[int]:
    """Numbers of the barriers of a source: any of them can be left out (HostDriver)."""
    first = 100 * SOURCES.index(source)
    return [first + i for i in range(len(BARRIER.findall(read_source(f"{source}.cu"))))]


def build_on_host(folder: Path, counted: bool = False) -> ctypes.CDLL:
    """The sources of vdgs.kernels.cuda as a library for the processor; `host_NAME` runs one thread of a kernel. The
    library is kept in the folder, where the same sources are found again.

    `counted`: what they read and write can be counted (cuda_traffic.py).
    """
    text = "".join(map(_on_host, SOURCES))
    library = folder / f"{sha256(text.encode()).hexdigest()}{'-counted' if counted else ''}.so"
    with library.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # others wait and find it
        if not library.exists():
            with TemporaryDirectory(dir=folder) as own:
                _build(text, Path(own), counted).rename(library)
    return ctypes.CDLL(str(library))


def _on_host(source: str) -> str:
    """A source in a namespace of its own, its barriers numbered."""
    text, numbers = read_source(f"{source}.cu"), iter(barriers_of(source))
    text = BARRIER.sub(lambda found: f"maybe_{found[1]}({next(numbers)}{')' if found[0].endswith(')') else ', '}", text)
    kernels = re.findall(r'extern "C" __global__ void(?: __launch_bounds__\([\w, ]+\))?\s+(\w+)\(', text)
    assert kernels, "no kernel in the source"
    exported = "\n".join(f"HOST_KERNEL({name})" for name in kernels)
    return f"namespace {source} {{\n{text}\n{exported}\n}}\n"


def _build(text: str, folder: Path, counted: bool) -> Path:
    (folder / "host.cpp").write_text(f'#include "cuda_on_host.h"\n#include "gaussian_math.h"\n{text}')
    library, built = folder / "host.so", folder / "host.o"
    # Fibers jump between stacks, which fortified longjmp takes for an attack. Before every access to memory the thread
    # sanitizer calls a function; its own library, which is not asked for when linking, has other ones.
    watched = ["-O1", "-fsanitize=thread"] if counted else ["-O2"]
    _run_compiler(*watched, "-I", str(HERE), "-I", str(SHARED), "-c", str(folder / "host.cpp"), "-o", str(built))
    counting = [str(HERE / "cuda_traffic.cpp")] if counted else []
    _run_compiler("-O2", "-shared", str(built), *counting, "-o", str(library))
    return library


def _run_compiler(*options: str) -> None:
    command = [str(host_compiler()), "-std=c++17", "-U_FORTIFY_SOURCE", "-fPIC", *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def no_code(*_: object, **__: object) -> bytes:
    """In place of `launch.compile_source`, for drivers that run the text itself: NVRTC takes long
    (kernels/test_cuda_compiling.py compiles every source)."""
    return b""


class Stuck(Exception):
    """A kernel that a GPU may not survive."""


class HostDriver:
    """`vdgs.kernels.cuda.driver.Driver` on tensors in main memory, whatever device they say that they are on.

    `left_out`: the number of a barrier at which nobody waits (`barriers_of`).
    """

    def __init__(self, library: ctypes.CDLL, order: int = 0, device_type: str = "cpu", left_out: int = -1):
        self._library, self.order, self.device_type, self._left_out = library, order, device_type, left_out
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
            ctypes.c_uint(self.order), ctypes.c_int(self._left_out),
        )  # fmt: skip
        if not whole:
            raise Stuck("threads of a block wait for others that never come")


try:
    COMPILER: Nvrtc | None = nvrtc.get_nvrtc()
except CudaUnavailable:
    COMPILER = None


needs_nvrtc = pytest.mark.skipif(COMPILER is None, reason="NVRTC is not installed: pip install nvidia-cuda-nvrtc")
needs_a_compiler = pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler")
