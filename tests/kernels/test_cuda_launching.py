"""Launching without a GPU: what libcuda would be asked, and what becomes of its errors."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

import pytest
import torch
from torch._subclasses import FakeTensorMode

from support.commands import python
from vdgs.errors import VdgsError
from vdgs.kernels.cuda import driver as driver_module
from vdgs.kernels.cuda.driver import CudaDriver, CudaUnavailable, DriverError, get_cuda_driver
from vdgs.kernels.cuda.launch import CudaProgram, common_device, pack_arguments

CARD = torch.device("cuda", 1)


class StandIn:
    """libcuda with two cards. Notes what it is asked; `refuse` gives error codes by function."""

    def __init__(self, **refuse: int):
        self.asked: list[str] = []
        self.refuse = refuse
        self.launched: tuple | None = None

    def __getattr__(self, name: str):
        def call(*arguments) -> int:
            self.asked.append(name)
            if name in self.refuse:
                return self.refuse[name]
            getattr(type(self), f"_{name}", lambda *_: None)(self, *arguments)
            return 0

        return call

    def _cuDriverGetVersion(self, version):
        version._obj.value = 12080

    def _cuDeviceGetCount(self, count):
        count._obj.value = 2

    def _cuDeviceGet(self, device, index):
        device._obj.value = 70 + index

    def _cuDeviceGetName(self, name, size, device):
        assert size == 256
        name.value = f"Card {device.value}".encode()

    def _cuDeviceTotalMem_v2(self, memory, device):
        memory._obj.value = 10**9 * device.value

    def _cuDeviceGetAttribute(self, value, attribute, device):
        value._obj.value = {75: 8, 76: 6}[attribute]

    def _cuDevicePrimaryCtxRetain(self, context, device):
        context._obj.value = 1000 + device.value

    def _cuCtxPushCurrent_v2(self, context):
        self.asked[-1] += f" {context.value}"

    def _cuModuleLoadData(self, module, code):
        assert code.value == b"code"
        module._obj.value = 5

    def _cuModuleGetFunction(self, function, module, name):
        assert (module.value, name) == (5, b"kernel")
        function._obj.value = 6

    def _cuLaunchKernel(self, function, *rest):
        sides, (shared, stream, arguments, extra) = rest[:6], rest[6:]
        assert (shared.value, extra) == (0, None)
        self.launched = (function.value, tuple(side.value for side in sides), stream.value, arguments)

    def _cuGetErrorString(self, code, text):
        text._obj.value = {700: b"an illegal memory access was encountered"}.get(code)


@pytest.fixture
def _streams(monkeypatch: pytest.MonkeyPatch):
    streams = {CARD: SimpleNamespace(cuda_stream=77)}
    monkeypatch.setattr(torch.cuda, "current_stream", streams.__getitem__)


def test_cards_are_described():
    driver = CudaDriver(StandIn())
    assert driver.version() == (12, 8)
    first, second = driver.list_gpus()
    assert (first.index, first.name, first.memory_bytes, first.capability) == (0, "Card 70", 70 * 10**9, (8, 6))
    assert second.name == "Card 71"
    assert driver.capability(CARD) == (8, 6)


@pytest.mark.usefixtures("_streams")
def test_a_kernel_goes_to_torchs_stream_and_context():
    library = StandIn()
    driver = CudaDriver(library)
    function = driver.function(driver.load(b"code", CARD), "kernel")
    number = ctypes.c_int(3)
    _, pointers = pack_arguments([number])
    driver.launch(function, (4, 3, 2), (16, 8, 1), CARD, pointers)
    assert library.launched == (6, (4, 3, 2, 16, 8, 1), 77, pointers)
    launching = library.asked[library.asked.index("cuModuleGetFunction") + 1 :]
    assert launching == ["cuCtxPushCurrent_v2 1071", "cuLaunchKernel", "cuCtxPopCurrent_v2"]
    assert library.asked.count("cuDevicePrimaryCtxRetain") == 1  # once for each card


@pytest.mark.usefixtures("_streams")
@pytest.mark.parametrize(
    ("function", "code", "words"),
    [
        ("cuLaunchKernel", 700, r"illegal memory access.*error 700.*--device cpu"),
        ("cuLaunchKernel", 999, r"cuLaunchKernel failed: error 999"),
        ("cuModuleLoadData", 222, r"NVRTC is newer than the driver"),
        ("cuModuleLoadData", 2, r"memory is full"),
    ],
)
def test_an_error_of_the_driver_says_what_to_do(function, code, words):
    library = StandIn(**{function: code})
    driver = CudaDriver(library)

    def use() -> None:
        driver.load(b"code", CARD)
        driver.launch(6, (1, 1, 1), (1, 1, 1), CARD, pack_arguments([ctypes.c_int(0)])[1])

    with pytest.raises(DriverError, match=words) as raised:
        use()
    assert raised.value.code == code
    assert isinstance(raised.value, VdgsError)
    assert library.asked.count("cuCtxPopCurrent_v2") == sum("Push" in each for each in library.asked)


def test_no_card_and_no_driver(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(DriverError, match="No card is visible"):
        CudaDriver(StandIn(cuInit=100))
    monkeypatch.setattr(driver_module, "LIBRARY", "libcuda-that-is-not-there.so")
    with pytest.raises(CudaUnavailable, match=r"no NVIDIA driver here.*--device cpu"):
        get_cuda_driver.__wrapped__()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_the_benchmark_says_that_there_is_no_gpu():
    done = python(
        "import runpy, sys; sys.argv[1:] = []; runpy.run_module('experiments.microbench.gpu', run_name='__main__')"
    )
    assert done.returncode == 2
    assert done.stderr.startswith("No GPU to measure: ")
    assert "Traceback" not in done.stderr


def test_arguments_are_packed_as_the_driver_reads_them():
    tensor, numbers = torch.arange(3.0), (ctypes.c_int(-7), ctypes.c_float(0.25))
    data, pointers = pack_arguments([tensor, None, *numbers])
    kinds = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int, ctypes.c_float)
    read = [ctypes.cast(at, ctypes.POINTER(kind)).contents.value for at, kind in zip(pointers, kinds, strict=True)]
    assert read == [tensor.data_ptr(), None, -7, 0.25]
    assert data[0] == tensor.data_ptr()


class Counting:
    """A driver on main memory that only counts."""

    device_type = "cpu"

    def __init__(self):
        self.launched = 0

    def capability(self, device):
        return 8, 6

    def load(self, code, device):
        return 1

    def function(self, module, name):
        return 2

    def launch(self, *_):
        self.launched += 1


class TestChecks:
    def test_tensors_elsewhere(self):
        with pytest.raises(TypeError, match="on a cuda device, not on cpu"):
            common_device([torch.zeros(2), ctypes.c_int(1)], "cuda")

    def test_strided_tensors(self):
        with pytest.raises(ValueError, match=r"contiguous; one of shape \[3, 2\]"):
            common_device([torch.zeros(2, 3).T], "cpu")

    def test_several_devices(self):
        with FakeTensorMode(), pytest.raises(ValueError, match=r"several devices: cuda:0, cuda:1"):
            common_device([torch.zeros(2, device=f"cuda:{i}") for i in (0, 1)], "cuda")

    def test_no_tensor(self):
        with pytest.raises(ValueError, match="at least one tensor"):
            common_device([ctypes.c_int(1)], "cuda")

    @pytest.mark.parametrize(
        ("grid", "block"), [((1, 70_000), (32,)), ((-1,), (32,)), ((1,), (32, 64)), ((1,), (0,)), ((1,), (1, 1, 65))]
    )
    def test_sides_out_of_range(self, grid, block):
        with pytest.raises(ValueError, match="cannot be launched"):
            CudaProgram(name="loss.cu", driver=Counting()).launch("kernel", grid, block, torch.zeros(1))

    def test_an_empty_grid_is_nothing_to_do(self):
        driver = Counting()
        CudaProgram(name="loss.cu", driver=driver).launch("kernel", (0, 3), (32,), torch.zeros(1))
        assert driver.launched == 0
