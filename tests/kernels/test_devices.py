"""Which device computes: decided before any work begins."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from types import SimpleNamespace

import pytest
import torch

from vdgs.cli.doctor import cuda_checks as doctor_cuda
from vdgs.errors import VdgsError
from vdgs.kernels import cpu, cuda, device_selection, gpu, gsplat, operations, torch_ref
from vdgs.kernels.cuda import driver
from vdgs.kernels.cuda import nvrtc as nvrtc_module
from vdgs.kernels.cuda.driver import CudaUnavailable, GpuInfo
from vdgs.kernels.device_selection import DeviceUnavailable, SelectedDevice, select_device
from vdgs.kernels.gpu import rasterizer
from vdgs.kernels.gsplat import GsplatUnavailable


@pytest.fixture
def _two_cards(monkeypatch: pytest.MonkeyPatch):
    """As if this were a machine with two cards."""
    cards = [GpuInfo(index, "Card", 8 * 10**9, (8, 6)) for index in (0, 1)]
    monkeypatch.setattr(driver, "get_cuda_driver", lambda: SimpleNamespace(list_gpus=lambda: cards))
    monkeypatch.setattr(nvrtc_module, "get_nvrtc", lambda: None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


def test_the_sets_are_complete():
    assert tuple(sorted(operations.GPU_BACKENDS)) == operations.OPERATION_NAMES
    for name in operations.OPERATION_NAMES:
        assert all(callable(getattr(room, name)) for room in (cpu, torch_ref, gpu))


@pytest.mark.parametrize("operation", operations.OPERATION_NAMES)
def test_the_table_says_who_does_what(operation):
    """Each operation of the composed set is the one that the table names; where it names two, both have it."""
    ways = [import_module(f"vdgs.kernels.{way}") for way in operations.backends_for(operation, "cuda")]
    found = getattr(gpu, operation)
    assert all(hasattr(way, operation) for way in ways)
    if len(ways) == 1:
        assert found is getattr(ways[0], operation)
    else:
        assert found.__module__ == "vdgs.kernels.gpu.rasterizer"
    assert operations.backends_for(operation, "cpu") == ("cpu",)
    assert operations.backends_for(operation, "mps") == ("torch_ref",)


class TestWhichRasterizerDraws:
    @pytest.fixture(autouse=True)
    def _asked_anew(self):
        rasterizer.select_rasterizer.cache_clear()
        yield
        rasterizer.select_rasterizer.cache_clear()

    def test_the_own_kernels_unless_gsplat_is_asked_for(self, monkeypatch):
        monkeypatch.setattr(rasterizer, "load_gsplat", lambda: None)
        assert rasterizer.select_rasterizer("") is rasterizer.select_rasterizer("cuda") is cuda
        monkeypatch.setenv(rasterizer.RASTERIZER_ENV_VAR, "gsplat")
        assert rasterizer._drawing(depth=False) is gsplat
        assert rasterizer._drawing(depth=True) is cuda

    def test_gsplat_that_cannot_be_used_is_an_error(self, monkeypatch):
        def none() -> None:
            raise GsplatUnavailable("gsplat is not here")

        monkeypatch.setattr(rasterizer, "load_gsplat", none)
        assert rasterizer.select_rasterizer("") is cuda
        with pytest.raises(GsplatUnavailable, match="not here"):
            rasterizer.select_rasterizer("gsplat")

    def test_another_word_is_refused(self):
        with pytest.raises(VdgsError, match="VDGS_RASTERIZER must be gsplat, cuda or not set"):
            rasterizer.select_rasterizer("native")


def test_without_a_driver_auto_is_the_processor_and_loads_nothing(monkeypatch, tmp_path):
    monkeypatch.setattr(device_selection, "_no_card", lambda index: pytest.fail("a card was looked for"))
    monkeypatch.setattr(device_selection, "DRIVER_FOLDER", tmp_path / "none")
    monkeypatch.setattr(device_selection, "WSL_DEVICE", tmp_path / "none")
    assert select_device("auto") == SelectedDevice("cpu", "this machine has no NVIDIA GPU")
    assert select_device("cpu") == SelectedDevice("cpu", "as asked for")


@pytest.mark.parametrize("asked", ["cuda", "cuda:1"])
def test_a_card_that_cannot_be_used_is_refused(asked, monkeypatch):
    monkeypatch.setattr(device_selection, "_no_card", lambda index: f"there is no card {index}")
    with pytest.raises(DeviceUnavailable, match=rf"--device {asked}: there is no card \d\. Use --device cpu"):
        select_device(asked)


@pytest.mark.parametrize("asked", ["gpu", "cuda:", "cuda:x", "CPU", "", "cuda:0 "])
def test_other_words_are_refused(asked):
    with pytest.raises(VdgsError, match="choose auto, cpu, cuda or cuda:0"):
        select_device(asked)


@pytest.mark.usefixtures("_two_cards")
class TestWithCards:
    def test_the_card_that_is_asked_for(self):
        assert select_device("cuda") == SelectedDevice("cuda:0", "as asked for")
        assert select_device("cuda:1").device == "cuda:1"

    @pytest.mark.parametrize("sign", ["DRIVER_FOLDER", "WSL_DEVICE"])
    def test_auto_takes_the_first_card(self, sign, monkeypatch, tmp_path):
        monkeypatch.setattr(device_selection, "DRIVER_FOLDER", tmp_path / "none")
        monkeypatch.setattr(device_selection, sign, tmp_path)
        assert select_device("auto") == SelectedDevice("cuda:0", "there is a card that can be used")

    def test_processes_share_all_cards_but_where_one_is_asked_for_by_its_number(self):
        both = {"cuda:0": 8 * 10**9, "cuda:1": 8 * 10**9}
        assert device_selection.cards_of(select_device("cuda").device) == both
        for card in both:
            assert device_selection.cards_of(select_device(card).device) == {card: 8 * 10**9}
        assert device_selection.cards_of("cpu") == {}

    def test_cards_that_torch_cannot_use_are_left_out_and_named(self, monkeypatch):
        old, new = GpuInfo(0, "Old", 4 * 10**9, (5, 2)), GpuInfo(1, "New", 8 * 10**9, (8, 9))
        monkeypatch.setattr(driver, "get_cuda_driver", lambda: SimpleNamespace(list_gpus=lambda: [old, new]))
        monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: ["sm_75", "sm_80", "sm_90a", "compute_120"])
        device = select_device("cuda").device
        assert (device, device_selection.cards_of(device)) == ("cuda:1", {"cuda:1": 8 * 10**9})
        assert "card 0 (Old) is not used: this torch" in device_selection.cards_left_out(device)[0]
        assert device_selection.cards_left_out("cuda:1") == []
        with pytest.raises(DeviceUnavailable, match=r"not built for its capability, 5\.2"):
            select_device("cuda:0")
        monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
        assert "torch sees 1 card only" in device_selection.cards_left_out(device)[1]

    def test_a_card_that_is_not_there(self):
        with pytest.raises(DeviceUnavailable, match="no card 2; the driver knows 2"):
            select_device("cuda:2")

    def test_auto_without_a_driver_is_the_processor(self, monkeypatch, tmp_path):
        def none() -> None:
            raise CudaUnavailable("There is no NVIDIA driver here")

        monkeypatch.setattr(driver, "get_cuda_driver", none)
        monkeypatch.setattr(device_selection, "DRIVER_FOLDER", tmp_path)
        assert select_device("auto") == SelectedDevice("cpu", "There is no NVIDIA driver here")
        with pytest.raises(DeviceUnavailable, match="no NVIDIA driver here"):
            select_device("cuda")

    def test_a_torch_without_cuda(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        with pytest.raises(DeviceUnavailable, match="this torch"):
            select_device("cuda")


def test_deciding_needs_no_torch():
    code = "import sys, vdgs.kernels.device_selection as d; d.select_device('auto'); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


@pytest.mark.parametrize(
    "arguments",
    [
        ["train-coarse", "empty", "--output", "run"],
        ["run", "empty", "--output", "run"],
        ["render", "empty", "--output", "pictures"],
        ["eval", "empty"],
    ],
)
def test_every_verb_that_computes_refuses_before_it_begins(arguments, tmp_path, monkeypatch, capsys):
    from vdgs.cli.main import main

    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "config.yaml").touch()
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--device", "cuda"])
    assert ended.value.code == 1
    assert "--device cpu" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]  # nothing was written; what is in it did not matter


@pytest.mark.parametrize("device", ["auto", "cpu"])
def test_a_device_that_can_is_no_news(device, tmp_path, monkeypatch, capsys):
    from vdgs.cli.main import main

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["eval", "nowhere", "--device", device])
    said = capsys.readouterr()
    assert ended.value.code == 1
    assert "nowhere" in said.err
    assert "device" not in (said.out + said.err).replace(str(tmp_path), "")  # the path holds this test's name


def test_doctor_says_what_there_is(monkeypatch: pytest.MonkeyPatch, tmp_path):
    monkeypatch.setenv("VDGS_CUDA_CACHE", str(tmp_path))
    (tmp_path / "loss.cu-sm_86-0.bin").touch()
    cards = [GpuInfo(0, "A card", 24 * 10**9, (8, 6))]
    monkeypatch.setattr(
        doctor_cuda, "get_cuda_driver", lambda: SimpleNamespace(list_gpus=lambda: cards, version=lambda: (12, 8))
    )
    found = nvrtc_module.NvrtcLibrary("/somewhere/libnvrtc.so.13", "the wheel nvidia-cuda-nvrtc")
    monkeypatch.setattr(doctor_cuda, "get_nvrtc", lambda: SimpleNamespace(version=(13, 0), library_info=found))
    lines = {check.name: check for check in doctor_cuda.cuda_checks()}
    assert lines["CUDA card 0"].value == "A card, 24.0 GB, compute capability 8.6; driver for CUDA 12.8"
    assert lines["NVRTC"].value == "13.0, from the wheel nvidia-cuda-nvrtc: /somewhere/libnvrtc.so.13"
    assert lines["CUDA kernels"].value.startswith("compiled code in")
    assert lines["CUDA kernels"].value.endswith("1 entries")
    assert lines["on cpu: cpu"].value == f"all {len(operations.OPERATION_NAMES)} operations"
    assert lines["on cuda: cuda"].value == (
        "adam_tensors, add_view_statistics, count_visibility, cull, decode, decode_backward_adam, "
        "decode_for_training, mark_visible, photometric_loss, photometric_loss_vjp, splat_contributions"
    )
    assert lines["on cuda: cuda or gsplat"].value == "rasterize, rasterize_vjp"
    assert "adam_rows" in lines["on cuda: torch_ref"].value
    assert lines["--device auto"].value.startswith("cpu: ")
    assert all(check.is_ok for check in lines.values())


def test_doctor_where_there_is_nothing(monkeypatch: pytest.MonkeyPatch):
    def none() -> None:
        raise CudaUnavailable("not here. pip install something")

    monkeypatch.setattr(doctor_cuda, "get_cuda_driver", none)
    monkeypatch.setattr(doctor_cuda, "get_nvrtc", none)
    lines = {check.name: check for check in doctor_cuda.cuda_checks()}
    assert lines["CUDA driver"].state == lines["NVRTC"].state == "note"
    assert "pip install something" in lines["NVRTC"].remedy
