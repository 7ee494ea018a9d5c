"""`experiments.microbench.gpu` without a card, so that it does not fail on its first day: all, on a pretended card."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from experiments.microbench import gpu, gpu_training
from support.captures import tiny_scene, write_colmap
from support.cuda_on_host import host_compiler, needs_nvrtc
from support.fake_device import CARD, pretended_card
from support.fake_gsplat import needs_gsplat
from support.gpu_on_host import build, install
from support.next_commands import parse
from vdgs.kernels import device_selection
from vdgs.kernels.operations import OPERATION_NAMES

pytestmark = [
    pytest.mark.slow,
    needs_nvrtc, needs_gsplat, pytest.mark.xdist_group("composition"),
    pytest.mark.skipif(host_compiler() is None, reason="no C++ compiler"),
]  # fmt: skip


@pytest.fixture(scope="module")
def drivers(compiled_code):
    return build(compiled_code)


def test_all_of_it_runs_and_agrees(drivers, tmp_path, monkeypatch, capsys):
    install(drivers, monkeypatch, "cuda", "")
    monkeypatch.setattr(device_selection, "_no_card", lambda index: "")
    # Of each kind of kernel one source: kernels/test_cuda_compiling.py compiles them all.
    monkeypatch.setattr(gpu, "SOURCES", {name: gpu.SOURCES[name] for name in ("cull.cu", "statistics.cu")})
    monkeypatch.setattr(gpu, "TOWN_DB", 3.0)  # after three iterations, less says nothing
    monkeypatch.setattr(gpu, "SMALL", replace(gpu.SMALL, iterations=3))
    run_command = gpu.run_command

    def run(verb: str, *arguments: str) -> None:
        """Without a town, which takes seconds: kernels that run on the processor take long for each anchor."""
        if verb != "synth":
            return run_command(verb, *arguments)
        parse([verb, *arguments])
        write_colmap(Path(arguments[0]), tiny_scene(columns=3, rows=2, width=32, height=24, points=80))

    monkeypatch.setattr(gpu, "run_command", run)
    capture, train, asked = tmp_path / "capture", gpu.train_and_measure, []

    def trained(place: Path, *rest: object) -> tuple[float, float]:
        """That of the town is really trained on both devices, as one's own capture would be."""
        asked.append((place, *rest[1:]))
        return (20.0, 1.0) if place == capture else train(place, *rest)

    monkeypatch.setattr(gpu, "train_and_measure", trained)
    device = gpu.GpuDevice(CARD, lambda: None, lambda: None, lambda: 0, (8, 6))
    with pretended_card():
        code = gpu.main(["--small", "--minutes", "1000", "--capture", str(capture), "--iterations", "4"], device)
    said = capsys.readouterr()
    assert code == 0, said.err
    for operation in OPERATION_NAMES:
        assert f"{operation}: " in said.out or f"{operation} by cuda: " in said.out
    for kernel in ("mark_anchors", "write_rows", "add_view"):
        assert f"{kernel:22}" in said.out
    for line in ("rasterize_vjp by gsplat: gradient means_px", "a generated town", "cuda   "):
        assert line in said.out
    assert "gsplat  40x32" in said.out
    assert "cuda    40x32" in said.out
    assert "B for each anchor in view" in said.out
    assert [each[1:3] for each in asked] == [("cpu", 3), ("cuda", 3), ("cuda", 4)]
    assert "capture: 20.00 dB after 4 iterations" in said.out


def test_what_differs_or_fails_is_told_and_the_rest_goes_on(monkeypatch, capsys):
    device = gpu.GpuDevice(torch.device("cpu"), lambda: None, lambda: None, lambda: 0, (8, 6))
    for name in ("print_resources", "train_town", "print_memory"):
        monkeypatch.setattr(gpu, name, lambda *_: None)

    def fails(*_: object) -> None:
        raise RuntimeError("the card fell out")

    far = [gpu.gpu_parity.Difference("decode", "", "conics", "value", 0.5)]
    monkeypatch.setattr(gpu.gpu_parity, "differences", lambda *_: far)
    monkeypatch.setattr(gpu, "time_steps", fails)
    assert gpu.main(["--small"], device) == 1
    said = capsys.readouterr()
    assert "decode: conics differs by 5.0e-01" in said.err
    assert "a training step: RuntimeError: the card fell out" in said.err
    assert "memory" in said.out


def test_what_there_is_no_time_for_is_named(capsys):
    device = gpu.GpuDevice(torch.device("cpu"), lambda: None, lambda: None, lambda: 0, (8, 6))
    assert gpu.main(["--small", "--minutes", "-1"], device) == 0
    assert "no time was left for: parity with the processor" in capsys.readouterr().out


@pytest.mark.parametrize("size", [float("nan"), float("inf"), 2e-4])
def test_a_number_that_is_none_is_no_agreement(size):
    assert not gpu.gpu_parity.Difference("decode", "", "conics", "value", size).agrees


def test_steps_of_a_training_are_told_by_what_they_draw(tmp_path, capsys):
    """On the processor, of which the profiler tells nothing."""
    write_colmap(tmp_path / "capture", tiny_scene(columns=3, rows=2, width=32, height=24, points=80))
    train_step = gpu_training.training_loop.train_step
    command = ["train-coarse", str(tmp_path / "capture"), "--output", str(tmp_path / "run"), "--device", "cpu"]
    rest = ["--iterations", "40", "--preset", "laptop", "--quiet", "--densify.start", "5"]
    assert gpu_training.main(["--", *command, *rest]) == 0
    said = capsys.readouterr().out
    # Iterations 28 to 39: of these every second compares depths, and every fourth has a pseudo view besides.
    for kind, count in (("plain", 6), ("with depths", 3), ("with depths and pseudo view", 3)):
        assert re.search(rf"^{kind} +[\d.]+ ms, median of {count}$", said, re.MULTILINE), said
    assert gpu_training.training_loop.train_step is train_step
    assert gpu_training.main(["--", *command, "--no-such-option"]) == 2
