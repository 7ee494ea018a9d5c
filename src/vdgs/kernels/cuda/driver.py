"""The CUDA driver through ctypes: GPUs, loading of compiled code, launches. Tests replace `CudaDriver` by a `Driver`
that needs no GPU."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol, runtime_checkable

import torch

from vdgs.kernels.cuda.nvrtc import CudaUnavailable

LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
#: CUdevice_attribute.
CAPABILITY_MAJOR, CAPABILITY_MINOR = 75, 76
#: What to do about some CUresults; the driver's own words come before it.
HINTS = {
    2: "The card's memory is full: draw smaller pictures or use --device cpu.",
    100: "No card is visible: look at nvidia-smi and CUDA_VISIBLE_DEVICES.",
    209: "The code is for another card: delete the folder of compiled code that `vdgs doctor` names.",
    222: "NVRTC is newer than the driver: update the driver, or install an nvidia-cuda-nvrtc of the driver's version.",
    700: "A kernel read or wrote outside its memory. Please report it; --device cpu works meanwhile.",
    803: "The driver's library does not fit the driver that runs: restart the machine or reinstall the driver.",
}

GridSize = tuple[int, int, int]


class DriverError(CudaUnavailable):
    """The CUDA driver refused. `code` is its CUresult."""

    def __init__(self, message: str, code: int):
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class GpuInfo:
    """A GPU as the driver describes it."""

    index: int
    name: str
    memory_bytes: int
    capability: tuple[int, int]


@runtime_checkable
class Driver(Protocol):
    """What launching needs. Handles are the driver's own, as integers. Every function raises DriverError."""

    #: The type of the devices that tensors must be on.
    device_type: str

    def capability(self, device: torch.device) -> tuple[int, int]:
        """Compute capability of a device."""

    def load(self, code: bytes, device: torch.device) -> int:
        """Load a cubin or PTX on a device: the module."""

    def function(self, module: int, name: str) -> int:
        """A kernel of a module, by its unmangled name."""

    def launch(self, function: int, grid: GridSize, block: GridSize, device: torch.device, arguments: Any) -> None:
        """Queue a kernel on torch's current stream of the device. `arguments`: a ctypes array of pointers to them."""


class CudaDriver:
    """libcuda, on the primary context of each device, which torch uses too."""

    device_type = "cuda"

    def __init__(self, library: Any):
        """`library` offers the driver's C functions. Raises DriverError if the driver does not start."""
        self._library = library
        self._contexts: dict[int, int] = {}
        self._call("cuInit", 0)

    def version(self) -> tuple[int, int]:
        """The newest CUDA that the driver knows."""
        found = ctypes.c_int()
        self._call("cuDriverGetVersion", ctypes.byref(found))
        return found.value // 1000, found.value % 1000 // 10

    def list_gpus(self) -> list[GpuInfo]:
        """Every visible GPU."""
        count = ctypes.c_int()
        self._call("cuDeviceGetCount", ctypes.byref(count))
        return [self._gpu(index) for index in range(count.value)]

    def capability(self, device: torch.device) -> tuple[int, int]:
        handle = self._device(_index(device))
        return self._attribute(CAPABILITY_MAJOR, handle), self._attribute(CAPABILITY_MINOR, handle)

    def load(self, code: bytes, device: torch.device) -> int:
        module = ctypes.c_void_p()
        with self._current(_index(device)):
            # A terminating zero, which PTX needs and a cubin ignores.
            self._call("cuModuleLoadData", ctypes.byref(module), ctypes.c_char_p(code + b"\0"))
        return _handle(module)

    def function(self, module: int, name: str) -> int:
        function = ctypes.c_void_p()
        self._call("cuModuleGetFunction", ctypes.byref(function), ctypes.c_void_p(module), name.encode())
        return _handle(function)

    def launch(self, function: int, grid: GridSize, block: GridSize, device: torch.device, arguments: Any) -> None:
        stream = torch.cuda.current_stream(device).cuda_stream
        with self._current(_index(device)):
            self._call(
                "cuLaunchKernel", ctypes.c_void_p(function), *(ctypes.c_uint(side) for side in (*grid, *block)),
                ctypes.c_uint(0), ctypes.c_void_p(stream), arguments, None,
            )  # fmt: skip

    @contextmanager
    def _current(self, index: int) -> Iterator[None]:
        """Make the primary context of a device the calling thread's, which in autograd's threads may have none."""
        if index not in self._contexts:
            context = ctypes.c_void_p()
            self._call("cuDevicePrimaryCtxRetain", ctypes.byref(context), self._device(index))
            self._contexts[index] = _handle(context)
        self._call("cuCtxPushCurrent_v2", ctypes.c_void_p(self._contexts[index]))
        try:
            yield
        finally:
            self._call("cuCtxPopCurrent_v2", ctypes.byref(ctypes.c_void_p()))

    def _gpu(self, index: int) -> GpuInfo:
        device = self._device(index)
        name, memory = ctypes.create_string_buffer(256), ctypes.c_size_t()
        self._call("cuDeviceGetName", name, len(name), device)
        self._call("cuDeviceTotalMem_v2", ctypes.byref(memory), device)
        major, minor = (self._attribute(each, device) for each in (CAPABILITY_MAJOR, CAPABILITY_MINOR))
        return GpuInfo(index, name.value.decode(errors="replace"), memory.value, (major, minor))

    def _device(self, index: int) -> ctypes.c_int:
        device = ctypes.c_int()
        self._call("cuDeviceGet", ctypes.byref(device), index)
        return device

    def _attribute(self, attribute: int, device: ctypes.c_int) -> int:
        value = ctypes.c_int()
        self._call("cuDeviceGetAttribute", ctypes.byref(value), attribute, device)
        return value.value

    def _call(self, name: str, *arguments: Any) -> None:
        code = int(getattr(self._library, name)(*arguments))
        if code:
            remedy = HINTS.get(code, "--device cpu works without the card.")
            raise DriverError(f"CUDA driver: {name} failed: {self._explain(code)}. {remedy}", code)

    def _explain(self, code: int) -> str:
        text = ctypes.c_char_p()
        if self._library.cuGetErrorString(code, ctypes.byref(text)) or not text.value:
            return f"error {code}"
        return f"{text.value.decode()} (error {code})"


@cache
def get_cuda_driver() -> CudaDriver:
    """The driver of this machine. Raises CudaUnavailable if there is none, or no card."""
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise CudaUnavailable(f"There is no NVIDIA driver here ({error}). --device cpu needs none.") from error
    return CudaDriver(library)


def _index(device: torch.device) -> int:
    return torch.cuda.current_device() if device.index is None else device.index


def _handle(pointer: ctypes.c_void_p) -> int:
    assert pointer.value is not None, "the driver reported success and gave no handle"
    return pointer.value
