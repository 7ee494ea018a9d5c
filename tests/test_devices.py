"""Which device computes: decided before any work begins."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from vdgs.doctor import cuda as doctor_cuda
from vdgs.errors import VdgsError
from vdgs.kernels import cuda, devices, native, operations, reference
from vdgs.kernels.cuda import driver
from vdgs.kernels.cuda import nvrtc as nvrtc_module
from vdgs.kernels.cuda.driver import Card, CudaUnavailable
from vdgs.kernels.devices import Choice, DeviceUnavailable, choose


@pytest.fixture
def _everything_on_cuda(monkeypatch: pytest.MonkeyPatch):
    """As if every operation had a CUDA implementation, on a machine with two cards."""
    cards = [Card(index, "Card", 8 * 10**9, (8, 6)) for index in (0, 1)]
    monkeypatch.setattr(devices, "missing_on_cuda", lambda: ())
    monkeypatch.setattr(driver, "cuda_driver", lambda: SimpleNamespace(cards=lambda: cards))
    monkeypatch.setattr(nvrtc_module, "nvrtc", lambda: None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


def test_the_list_of_operations_is_what_there_is():
    assert operations.OPERATIONS == tuple(sorted(native.__all__)) == tuple(sorted(reference.__all__))
    assert tuple(sorted(cuda.__all__)) == operations.CUDA_OPERATIONS
    assert set(operations.missing_on_cuda()) == set(native.__all__) - set(cuda.__all__)


def test_today_the_processor_does_everything():
    assert choose("auto") == Choice("cpu", "1 of 17 operations run on GPUs so far")
    assert choose("cpu").device == "cpu"
    assert choose("cpu") == Choice("cpu", "as asked for")


@pytest.mark.parametrize("asked", ["cuda", "cuda:1"])
def test_a_card_is_refused_with_what_is_missing(asked):
    with pytest.raises(
        DeviceUnavailable, match=rf"--device {asked}: .*photometric_loss is there; .*rasterise"
    ) as raised:
        choose(asked)
    assert "--device cpu" in str(raised.value)
    assert all(name in str(raised.value) for name in operations.missing_on_cuda())


@pytest.mark.parametrize("asked", ["gpu", "cuda:", "cuda:x", "CPU", "", "cuda:0 "])
def test_other_words_are_refused(asked):
    with pytest.raises(VdgsError, match="choose auto, cpu, cuda or cuda:0"):
        choose(asked)


@pytest.mark.usefixtures("_everything_on_cuda")
class TestOnceEverythingIsThere:
    def test_auto_takes_the_first_card(self):
        assert choose("auto") == Choice("cuda:0", "every operation runs on it")
        assert choose("cuda:1").device == "cuda:1"

    def test_a_card_that_is_not_there(self):
        with pytest.raises(DeviceUnavailable, match="no card 2; the driver knows 2"):
            choose("cuda:2")

    def test_auto_without_a_driver_is_the_processor(self, monkeypatch):
        def none() -> None:
            raise CudaUnavailable("There is no NVIDIA driver here")

        monkeypatch.setattr(driver, "cuda_driver", none)
        assert choose("auto") == Choice("cpu", "There is no NVIDIA driver here")
        with pytest.raises(DeviceUnavailable, match="no NVIDIA driver here"):
            choose("cuda")

    def test_a_torch_without_cuda(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        assert "this torch" in choose("auto").why


def test_deciding_needs_no_torch():
    code = "import sys, vdgs.kernels.devices as d; d.choose('auto'); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


@pytest.mark.parametrize(
    "arguments",
    [
        ["coarse", "nowhere", "--output", "run"],
        ["run", "nowhere", "--output", "run"],
        ["render", "nowhere", "--output", "pictures"],
        ["eval", "nowhere"],
    ],
)
def test_every_verb_that_computes_refuses_before_it_begins(arguments, tmp_path, monkeypatch, capsys):
    from vdgs.cli import main

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--device", "cuda"])
    assert ended.value.code == 1
    assert "--device cpu" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []  # nothing was written, and that there is no capture did not matter yet


@pytest.mark.parametrize("device", ["auto", "cpu"])
def test_a_device_that_can_is_no_news(device, tmp_path, monkeypatch, capsys):
    from vdgs.cli import main

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["eval", "nowhere", "--device", device])
    said = capsys.readouterr()
    assert ended.value.code == 1
    assert "nowhere" in said.err
    assert "device" not in said.out + said.err


def test_doctor_says_what_there_is(monkeypatch: pytest.MonkeyPatch, tmp_path):
    monkeypatch.setenv("VDGS_CUDA_CACHE", str(tmp_path))
    (tmp_path / "loss.cu-sm_86-0.bin").touch()
    cards = [Card(0, "A card", 24 * 10**9, (8, 6))]
    monkeypatch.setattr(
        doctor_cuda, "cuda_driver", lambda: SimpleNamespace(cards=lambda: cards, version=lambda: (12, 8))
    )
    found = nvrtc_module.Found("/somewhere/libnvrtc.so.13", "the wheel nvidia-cuda-nvrtc")
    monkeypatch.setattr(doctor_cuda, "nvrtc", lambda: SimpleNamespace(version=(13, 0), found=found))
    lines = {check.name: check for check in doctor_cuda.looks()}
    assert lines["CUDA card 0"].value == "A card, 24.0 GB, compute capability 8.6; driver for CUDA 12.8"
    assert lines["NVRTC"].value == "13.0, from the wheel nvidia-cuda-nvrtc: /somewhere/libnvrtc.so.13"
    assert lines["CUDA kernels"].value.startswith("1 of 17 operations: photometric_loss; compiled code in")
    assert lines["CUDA kernels"].value.endswith("1 entries")
    assert lines["--device auto"].value.startswith("cpu: 1 of 17 operations")
    assert all(check.works for check in lines.values())


def test_doctor_where_there_is_nothing(monkeypatch: pytest.MonkeyPatch):
    def none() -> None:
        raise CudaUnavailable("not here. pip install something")

    monkeypatch.setattr(doctor_cuda, "cuda_driver", none)
    monkeypatch.setattr(doctor_cuda, "nvrtc", none)
    lines = {check.name: check for check in doctor_cuda.looks()}
    assert lines["CUDA driver"].state == lines["NVRTC"].state == "note"
    assert "pip install something" in lines["NVRTC"].remedy
