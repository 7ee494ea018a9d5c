"""Memory: what training will take, what helps, and what happens when there is none left."""

from __future__ import annotations

import ctypes
import errno
import json
import platform
import re
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import psutil
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from support.commands import vdgs
from vdgs.config.method import CompensationConfig, LossConfig, TrainConfig
from vdgs.config.presets import PRESETS
from vdgs.geometry.camera import Camera
from vdgs.system.memory.memory_errors import is_out_of_memory
from vdgs.system.memory.memory_estimate import (
    MAX_COMPENSATED_GROWTH,
    MAX_GROWTH,
    TrainingWorkload,
    block_workload,
    bytes_per_anchor,
    describe_memory,
    estimate_memory,
    max_growth_factor,
    max_image_pixels,
    memory_advice,
    train_bytes_per_pixel,
)
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.training.session import memory_advice as memory_advice_module
from vdgs.training.session import trainer as watching
from vdgs.training.session.memory_advice import print_memory_estimate

pytestmark = pytest.mark.slow

needs = st.builds(
    TrainingWorkload,
    anchors=st.integers(1, 10**7),
    max_anchors=st.integers(0, 10**7),
    offsets=st.integers(1, 20),
    seen=st.floats(0, 1),
    pixels=st.integers(1, 10**8),
    image_cache_bytes=st.integers(0, 10**11),
    surroundings=st.integers(0, 10**7),
    has_swa=st.booleans(),
    growth=st.floats(1, 20),
)


def test_an_anchor_takes_what_was_measured():
    """experiments/microbench/step.py in reports/results.md: 0.92 kB out of view, 2.43 to 2.50 kB in view."""
    assert bytes_per_anchor(10, 0.0) == pytest.approx(920, rel=0.05)
    assert bytes_per_anchor(10, 1.0) == pytest.approx(2460, rel=0.05)


@given(needs)
def test_what_is_more_takes_more(need):
    found = estimate_memory(need)
    assert found.start <= found.total
    for name in ("anchors", "offsets", "pixels", "image_cache_bytes", "surroundings"):
        assert estimate_memory(replace(need, **{name: 2 * getattr(need, name)})).total >= found.total
    assert (
        estimate_memory(replace(need, max_anchors=need.anchors)).total
        == estimate_memory(replace(need, max_anchors=1)).total
    )


def test_the_picture_of_a_block_counts_in_the_largest_size_that_it_trains_with():
    cameras = [
        Camera(camera_from_world=np.eye(4), fx=1, fy=1, cx=0, cy=0, width=width, height=height)
        for width, height in ((4000, 3000), (5472, 3648), (3648, 5472))
    ]
    assert max_image_pixels(cameras, ((0.0, 4), (0.1, 2), (0.4, 1))) == 5472 * 3648
    assert max_image_pixels(cameras, ((0.0, 4), (0.5, 2))) == 2736 * 1824
    default, laptop = (block_workload(PRESETS[name], 50_000, 400_000, 5472 * 3648) for name in ("default", "laptop"))
    assert (estimate_memory(laptop).image, estimate_memory(default).image) == (175 * 5472 * 3648, 80 * 5472 * 3648)
    assert (laptop.has_swa, default.has_swa) == (True, False)
    assert (laptop.max_grown_anchors, default.max_grown_anchors) == (150_000, 750_000)
    assert laptop.surroundings == 350_000
    paper = block_workload(PRESETS["paper"], 50_000, 400_000, 5472 * 3648)  # whose margin moves, too
    assert (paper.anchors, paper.surroundings) == (98_000, 302_000)


def test_what_a_step_draws_decides_what_a_pixel_takes():
    """Measured of five steps of 6 megapixels; and the photographs that are decoded in advance, 3 bytes each."""
    ahead = 4 * 3
    for exposure, depth, pseudo, sky, measured in (
        (False, 0.0, 0.0, False, 65),
        (True, 0.0, 0.0, False, 86),
        (False, 0.05, 0.0, False, 105),
        (True, 0.05, 0.0, False, 125),
        (False, 0.0, 0.3, False, 141),
        (True, 0.0, 0.3, False, 154),
        (True, 0.05, 0.3, False, 166),
        (False, 0.0, 0.0, True, 158),
    ):
        loss = LossConfig(depth_agreement=depth, pseudo_views=pseudo)
        found = train_bytes_per_pixel(TrainConfig(loss=loss, exposure_compensation=exposure), sky)
        assert found == pytest.approx(measured + ahead, rel=0.08)


def test_growth_below_a_fixed_threshold_is_expected_to_be_large():
    """On a real capture nearly all anchors are seen by fewer than a fifth of the cameras."""
    growths = {name: max_growth_factor(preset.block.compensation) for name, preset in PRESETS.items()}
    assert growths == {"default": MAX_COMPENSATED_GROWTH, "paper": MAX_COMPENSATED_GROWTH, "laptop": MAX_GROWTH}
    lowest = CompensationConfig(t_low_quantile=0.25)
    assert max_growth_factor(lowest) == max_growth_factor(PRESETS["default"].training.compensation) == MAX_GROWTH


@given(needs)
def test_a_mean_of_models_takes_one_more_model(need):
    plain, averaged = (estimate_memory(replace(need, has_swa=each)) for each in (False, True))
    assert averaged.start == plain.start
    more = averaged.total - plain.total
    assert more == pytest.approx(4 * (32 + 6 + 3 * need.offsets) * need.max_grown_anchors, abs=1, rel=1e-9)


@pytest.mark.parametrize(("kind", "option"), [("coarse", "--swa-fraction 0"), ("block", "--block.swa-fraction 0")])
def test_the_mean_may_be_given_up(kind, option):
    need = TrainingWorkload(
        anchors=1_000_000, max_anchors=0, offsets=10, seen=0.4, pixels=10**6, image_cache_bytes=10**8, has_swa=True
    )
    (found,) = [each for each in memory_advice(need, kind, 10**9) if option in each.setting]
    assert found.saved_bytes == estimate_memory(need).total - estimate_memory(replace(need, has_swa=False)).total
    assert not [each for each in memory_advice(replace(need, has_swa=False), kind, 10**9) if option in each.setting]


@pytest.mark.parametrize("kind", ["coarse", "block"])
@given(need=needs, share=st.floats(0.01, 0.9))
def test_advice_is_worth_its_words(kind, need, share):
    whole = estimate_memory(need).total
    found = memory_advice(need, kind, int(share * whole))
    assert [each.saved_bytes for each in found] == sorted((each.saved_bytes for each in found), reverse=True)
    for each in found:
        assert whole / 100 < each.saved_bytes <= whole
        assert "--" in each.setting


@pytest.mark.parametrize("averaged", [False, True])
def test_the_limit_of_anchors_makes_it_fit(averaged):
    need = TrainingWorkload(
        anchors=1_000_000, max_anchors=0, offsets=10, seen=0.4, pixels=10**6, image_cache_bytes=10**8, has_swa=averaged
    )
    missing = 10**9
    (limit,) = [each for each in memory_advice(need, "coarse", missing) if "max-anchors" in each.setting]
    given = int(limit.setting.split()[1])
    assert need.anchors < given < need.max_grown_anchors
    saved = estimate_memory(need).total - estimate_memory(replace(need, max_anchors=given)).total
    assert missing <= saved == limit.saved_bytes <= 1.01 * missing
    # Growth that would have to be undone is not promised.
    (least,) = [each for each in memory_advice(need, "coarse", 10**12) if "max-anchors" in each.setting]
    assert least.setting.startswith("--densify.max-anchors 1000000 ")


def test_the_line_for_people_says_what_takes_it_and_what_there_is():
    line = describe_memory(
        estimate_memory(
            TrainingWorkload(
                anchors=100_000, max_anchors=200_000, offsets=10, seen=0.5, pixels=10**6, image_cache_bytes=2 * 10**8
            )
        ),
        3 * 10**9,
    )
    assert line.startswith("memory by estimate: 802 MB at the start, 975 MB at most (photographs 200 MB")
    assert line.endswith("this process may take 3.00 GB")


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("coarse", ". --image-cache-gb may change when a run continues, other settings need a new --output."),
        ("block", ". --jobs and --image-cache-gb may change when a run continues, other settings need --overwrite."),
    ],
)
def test_a_warning_comes_before_training_where_it_will_not_fit(kind, said, monkeypatch, capsys):
    need = TrainingWorkload(
        anchors=1_000_000,
        max_anchors=0,
        offsets=10,
        seen=0.4,
        pixels=2 * 10**7,
        pixel_bytes=150,
        image_cache_bytes=10**9,
    )
    taken = psutil.Process().memory_info().rss  # it grows with the tests that ran before
    monkeypatch.setattr(memory_advice_module, "available_memory_bytes", lambda: int(5.4e9) - taken)
    print_memory_estimate(need, kind, Console(width=2000))
    line, warning, *_ = capsys.readouterr().out.splitlines()
    assert line.startswith("memory by estimate")
    assert warning.startswith("warning it may run out of memory: ")
    assert ("--densify.max-anchors 1000000" in warning) == (kind == "coarse")
    assert warning.endswith(said)
    monkeypatch.setattr(memory_advice_module, "available_memory_bytes", lambda: 10**11)
    print_memory_estimate(need, kind, Console(width=2000))
    assert "warning" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("std::bad_alloc"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("unable to mmap 400 bytes from file <x>: Cannot allocate memory (12)"),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        OSError("libgfortran.so: cannot map zero-fill pages"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] DefaultCPUAllocator: can't allocate memory: you tried"),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 40 bytes."),
        cv2.error("OpenCV(4.9) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9 bytes"),
    ],
)
def test_missing_memory_is_recognized(error):
    assert is_out_of_memory(error)


def test_other_errors_are_not_taken_for_it():
    assert not is_out_of_memory(RuntimeError("shape mismatch"))
    assert not is_out_of_memory(OSError(errno.ENOSPC, "No space left on device"))
    noexec = "x.so: failed to map segment from shared object: Operation not permitted"
    assert not is_out_of_memory(ImportError(noexec))


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space")
def test_a_limit_of_the_process_counts():
    code = (
        "import resource, psutil; from vdgs.system.memory.process_memory import available_memory_bytes\n"
        "vms = psutil.Process().memory_info().vms\n"
        "resource.setrlimit(resource.RLIMIT_AS, (vms + 10**8,) * 2); print(available_memory_bytes())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 0 < int(done.stdout) <= 10**8 < available_memory_bytes()


# ------------------------------------------------------------------------------------------ for real

#: Without stereo, which would leave room behind in which a step fits.
SETTINGS = (
    "--preset", "laptop", "--iterations", "5", "--up", "z", "--model.num-offsets", "3", "--threads", "1",
    "--init.no-mvs", "--images", "images",
)  # fmt: skip
#: The last iteration with photographs at half their size (preset laptop).
LAST_HALF = 2


def limit_memory_before_full_size() -> None:
    """Once this process begins with photographs at full size, it may take 8 MB more; a step takes three times that.

    From then on every large piece is asked of the system, so that nothing depends on what malloc has kept.
    """
    import resource

    train, mmap_threshold = watching.train, -3

    def limited(state, stage, *, after_step, **others):
        def step(state, report):
            after_step(state, report)
            if state.iteration == LAST_HALF:
                assert ctypes.CDLL(None).mallopt(mmap_threshold, 128 * 1024)
                most = psutil.Process().memory_info().vms + 8 * 10**6
                resource.setrlimit(resource.RLIMIT_AS, (most, most))

        return train(state, stage, after_step=step, **others)

    watching.train = limited  # type: ignore[assignment]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="limits of address space, and a malloc that can be told")
def test_training_that_runs_out_of_memory_saves_says_what_helps_and_continues(tmp_path):
    capture = tmp_path / "capture"
    write_colmap(capture, tiny_scene(columns=3, rows=2, width=720, height=540))
    command = ("train-coarse", capture, "--output", tmp_path / "run", *SETTINGS)
    broken = vdgs(*command, prepare=limit_memory_before_full_size)
    assert broken.returncode == 1, broken.stdout + broken.stderr
    assert "Traceback" not in broken.stderr
    assert "out of memory with" in broken.stderr
    assert re.search(r"half the size \(--downscale or --images images_N\) saves about \d+ MB", broken.stderr)
    folder = tmp_path / "run" / "coarse"
    (saved,) = (int(path.stem) for path in (folder / "checkpoints").glob("*.json"))
    assert saved >= LAST_HALF  # what malloc has at hand may serve a step more
    assert f"The checkpoint of iteration {saved} is saved in {folder / 'checkpoints'}." in broken.stderr
    assert json.loads((folder / "status.json").read_text())["reason"] == "out of memory"

    continued = vdgs(*command)
    assert f"continuing at iteration {saved}" in continued.stdout
    unbroken = vdgs("train-coarse", capture, "--output", tmp_path / "unbroken", *SETTINGS)
    assert continued.returncode == unbroken.returncode == 0
    models = [(tmp_path / run / "coarse" / "model.safetensors").read_bytes() for run in ("run", "unbroken")]
    assert models[0] == models[1]
    # The estimate of the whole run and what it took then.
    peak = json.loads((tmp_path / "unbroken/coarse/status.json").read_text())["peak_memory_bytes"]
    number, unit = unbroken.stdout.split("at the start, ")[1].split(" at most")[0].split()
    estimated = float(number) * {"MB": 1e6, "GB": 1e9}[unit]
    assert 0.6 < estimated / peak < 1.6
