"""From a source to a running kernel: compiled for the card at hand, loaded once, its arguments checked and packed."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import NoReturn
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import DILATION_PX2, FRUSTUM_MARGIN
from vdgs.kernels.cuda.compile_cache import load_or_compile
from vdgs.kernels.cuda.driver import Driver, GridSize, get_cuda_driver
from vdgs.kernels.cuda.nvrtc import CompileTarget, get_nvrtc

COMPILE_OPTIONS = ("--std=c++17",)
#: Limits of every card since compute capability 3.0.
MAX_GRID: GridSize = (2**31 - 1, 65535, 65535)
MAX_THREADS_PER_BLOCK = 1024

#: What a kernel may be given: a tensor (its data pointer), nothing (a null pointer), a ctypes number or a structure.
KernelArgument = Tensor | ctypes._SimpleCData | ctypes.Structure | None


def read_source(name: str) -> str:
    """A CUDA source of this package."""
    return resources.files(__package__).joinpath("source", name).read_text(encoding="utf-8")


def read_header(name: str) -> str:
    """A header that the C++ of the processor is made of too."""
    return (Path(__file__).parents[1] / "shared" / name).read_text(encoding="utf-8")


def compile_source(name: str, target: CompileTarget, *, headers: Sequence[str] = ()) -> bytes:
    """A source of this package with these shared headers, compiled, from the cache if it is there.

    Raises CompileError, CudaUnavailable.
    """
    compiler = get_nvrtc()
    source, texts = read_source(name), {title: read_header(title) for title in headers}
    parts = {f"header {title}": text for title, text in texts.items()}
    parts |= {
        "source": source,
        "options": "\n".join(COMPILE_OPTIONS),
        "target": target.name,
        "NVRTC": str(compiler.version),
    }
    return load_or_compile(
        f"{name}-{target.name}", parts, lambda: compiler.compile(name, source, texts, target, COMPILE_OPTIONS)
    )


@dataclass(eq=False, kw_only=True)
class CudaProgram:
    """The kernels of one source, compiled and loaded once for each device, at the first launch there."""

    name: str
    #: Stands in for the driver of this machine.
    driver: Driver | None = None
    #: Names of shared headers that it includes.
    headers: Sequence[str] = ()
    _functions: dict[tuple[torch.device, str], int] = field(default_factory=dict)
    _modules: dict[torch.device, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def launch(self, kernel: str, grid: Sequence[int], block: Sequence[int], *arguments: KernelArgument) -> None:
        """Queue a kernel on torch's current stream of the device that its tensors are on.

        Grid and block have up to three sides; a grid with a side of zero is nothing to do. Raises ValueError for
        tensors that are not contiguous or of several devices, or for sides out of range; TypeError for tensors of
        another kind of device; CudaUnavailable and CompileError where the kernel cannot be made or run.
        """
        driver = self.driver or get_cuda_driver()
        device = common_device(arguments, driver.device_type)
        blocks, threads = _sides(grid), _sides(block)
        _check_sides(blocks, threads)
        if 0 in blocks:
            return
        function = self._function(driver, device, kernel)
        data, pointers = pack_arguments(arguments)
        driver.launch(function, blocks, threads, device, pointers)
        del data  # the driver has copied it; until then the pointers lead there

    def _function(self, driver: Driver, device: torch.device, kernel: str) -> int:
        key = (device, kernel)
        known = self._functions.get(key)
        if known is not None:
            return known
        with self._lock:
            if key not in self._functions:
                if device not in self._modules:
                    target = get_nvrtc().target_for(driver.capability(device))
                    code = compile_source(self.name, target, headers=self.headers)
                    self._modules[device] = driver.load(code, device)
                self._functions[key] = driver.function(self._modules[device], kernel)
            return self._functions[key]


class PackedCamera(ctypes.Structure):
    """`Camera` of gaussian_math.h, field by field."""

    _fields_ = (
        *((name, 3 * ctypes.c_float) for name in ("right", "down", "forward", "center")),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "width", "height", "near")),
        *((name, ctypes.c_float) for name in ("limit_x", "limit_y", "blur")),
        ("orthographic", ctypes.c_bool),
    )  # fmt: skip

    @staticmethod
    def of(camera: Camera) -> PackedCamera:
        """As `unpack_camera` of gaussian_math.h makes it of the same numbers; kept as long as the camera is there."""
        if camera not in _packed_cameras:
            _packed_cameras[camera] = PackedCamera._made_of(camera)
        return _packed_cameras[camera]

    @staticmethod
    def _made_of(camera: Camera) -> PackedCamera:
        numbers = [float(each) for each in camera.packed]
        axes, translation = [numbers[:3], numbers[3:6], numbers[6:9]], numbers[9:12]
        center = [-sum(axis[i] * shift for axis, shift in zip(axes, translation, strict=True)) for i in range(3)]
        fx, fy, cx, cy, width, height, orthographic, near, whole_width, whole_height, pixel = numbers[12:]
        limits = (FRUSTUM_MARGIN * 0.5 * side / focal for side, focal in ((whole_width, fx), (whole_height, fy)))
        blur = DILATION_PX2 * pixel * pixel * fx * fy
        vectors = (tuple(vector) for vector in (*axes, center))
        return PackedCamera(*vectors, fx, fy, cx, cy, width, height, near, *limits, blur, bool(orthographic))


_packed_cameras: WeakKeyDictionary[Camera, PackedCamera] = WeakKeyDictionary()


def pack_arguments(
    arguments: Sequence[KernelArgument],
) -> tuple[ctypes.Array[ctypes.c_void_p], ctypes.Array[ctypes.c_void_p]]:
    """What a launch is given: addresses of data, which must outlive the call as the other arguments must, and an array
    of pointers to addresses and arguments. (An array and not an object for each: a step launches some twenty kernels of
    some twenty arguments, and is made to wait by nothing else on a small scene.)"""
    count = len(arguments)
    data, pointers = (ctypes.c_void_p * count)(), (ctypes.c_void_p * count)()
    first, size = ctypes.addressof(data), ctypes.sizeof(ctypes.c_void_p)
    for i, argument in enumerate(arguments):
        if argument is None:
            pointers[i] = first + i * size
        elif isinstance(argument, Tensor):
            data[i], pointers[i] = argument.data_ptr(), first + i * size
        else:
            pointers[i] = ctypes.addressof(argument)
    return data, pointers


def common_device(arguments: Sequence[KernelArgument], device_type: str) -> torch.device:
    """The device of all tensors. Raises TypeError or ValueError unless a kernel can read them all there."""
    tensors = [argument for argument in arguments if isinstance(argument, Tensor)]
    if not tensors:
        raise ValueError("a kernel must be given at least one tensor")
    device = tensors[0].device
    if device.type != device_type or not all(t.device == device and t.is_contiguous() for t in tensors):
        _refuse(tensors, device_type)
    return device


def _refuse(tensors: Sequence[Tensor], device_type: str) -> NoReturn:
    """Say what is wrong with the tensors of a kernel."""
    devices = {tensor.device for tensor in tensors}
    for device in devices:
        if device.type != device_type:
            raise TypeError(f"a kernel's tensors must be on a {device_type} device, not on {device}")
    for tensor in tensors:
        if not tensor.is_contiguous():
            raise ValueError(f"a kernel's tensors must be contiguous; one of shape {list(tensor.shape)} is not")
    raise ValueError(f"a kernel's tensors are on several devices: {', '.join(sorted(map(str, devices)))}")


def _sides(sides: Sequence[int]) -> GridSize:
    x, y, z = (*sides, 1, 1, 1)[:3]
    return x, y, z


def _check_sides(grid: GridSize, block: GridSize) -> None:
    if any(not 0 <= side <= most for side, most in zip(grid, MAX_GRID, strict=True)):
        raise ValueError(f"a grid of {grid} blocks cannot be launched; at most {MAX_GRID}")
    if min(block) < 1 or block[0] * block[1] * block[2] > MAX_THREADS_PER_BLOCK or block[2] > 64:
        raise ValueError(f"a block of {block} threads cannot be launched; at most {MAX_THREADS_PER_BLOCK}")
