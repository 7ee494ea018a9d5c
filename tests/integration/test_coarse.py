"""The coarse stage as people run it: real processes that are stopped, killed, damaged and continued."""

import json
import os
import random
import shutil
import signal
from functools import partial
from pathlib import Path
from subprocess import CompletedProcess

import cv2
import numpy as np
import pytest
import torch

from support.captures import tiny_scene, write_colmap
from support.commands import begun, limit_files, vdgs
from vdgs.errors import VdgsError
from vdgs.model.anchor_model import AnchorModel
from vdgs.pipeline.dense_points import PIXELS_PER_POINT
from vdgs.runs.open_run import open_run
from vdgs.system.stop_signals import STOP_SIGNALS
from vdgs.system.tensors import read_tensors

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("coarse")]

SETTINGS = (
    "--preset", "laptop", "--images", "images", "--iterations", "100", "--save-every", "10", "--model.num-offsets", "3",
    "--up", "z", "--densify.start", "30", "--densify.every", "10", "--densify.stats-start", "20",
    "--densify.min-draw-fraction", "0.05",
)  # fmt: skip
#: As many as the ten training photographs of a tiny scene can bear beside eighty sparse points; stereo finds more.
STEREO = f"stereo: {10 * 64 * 48 // PIXELS_PER_POINT - 80} points"


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    return folder


def command(capture: Path, run: Path, *more: str) -> list[str]:
    return ["train-coarse", str(capture), "--output", str(run), *SETTINGS, *more]


def finish(capture: Path, run: Path, *more: str) -> CompletedProcess[str]:
    return vdgs(*command(capture, run, *more))


def model_bytes(run: Path) -> bytes:
    return (run / "coarse" / "model.safetensors").read_bytes()


@pytest.fixture(scope="module")
def unbroken(capture, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("unbroken") / "run"
    done = vdgs(*command(capture, run))
    assert done.returncode == 0, done.stderr
    return run


def test_a_run_leaves_what_the_documents_say(unbroken):
    names = {str(path.relative_to(unbroken)) for path in unbroken.rglob("*") if path.is_file()}
    assert {
        "config.yaml",
        "capture.json",
        "coarse/model.safetensors",
        "coarse/log.jsonl",
        "coarse/status.json",
    } <= names
    assert not [name for name in names if name.endswith(".tmp")]
    log = [json.loads(line) for line in (unbroken / "coarse/log.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in log] == sorted({line["iteration"] for line in log})
    assert log[-1]["iteration"] == 100
    assert log[-1]["loss"] < 0.5 * log[0]["loss"]
    status = json.loads((unbroken / "coarse/status.json").read_text())
    assert status["state"] == "done"
    assert AnchorModel.load(unbroken / "coarse/model.safetensors").metadata.iterations == 100


def test_what_stereo_found_is_kept_and_looked_for_once(tmp_path):
    capture, run = tmp_path / "capture", tmp_path / "run"
    write_colmap(capture, tiny_scene(points=80))
    assert STEREO in finish(capture, run, "--iterations", "10").stdout
    file, before = run / "coarse/stereo.safetensors", model_bytes(run)
    found = read_tensors(file)[0]["points"].numpy()
    assert np.abs(found[:, 2]).max() < 1.5  # of a camera height of ten: the ground is flat
    kept = file.stat().st_mtime_ns
    (run / "coarse/model.safetensors").unlink()
    assert finish(capture, run, "--iterations", "10").returncode == 0
    assert file.stat().st_mtime_ns == kept
    assert model_bytes(run) == before
    (run / "coarse/model.safetensors").unlink()
    file.write_bytes(file.read_bytes()[:-8])
    broken = finish(capture, run, "--iterations", "10")
    assert broken.returncode == 1
    assert str(file) in broken.stderr
    assert "Delete it" in broken.stderr
    file.unlink()
    assert finish(capture, run, "--iterations", "10").returncode == 0
    assert np.array_equal(read_tensors(file)[0]["points"].numpy(), found)


def test_stereo_looks_at_photographs_in_full_whatever_size_they_are_trained_at(tmp_path):
    write_colmap(tmp_path / "capture", tiny_scene(points=80))
    done = finish(tmp_path / "capture", tmp_path / "run", "--iterations", "5", "--resolution-schedule", "0", "2")
    assert done.returncode == 0, done.stderr
    assert STEREO in done.stdout


def test_many_sparse_points_need_no_stereo(unbroken):
    assert len(read_tensors(unbroken / "coarse/stereo.safetensors")[0]["points"]) == 0


def test_a_finished_run_is_not_trained_again(capture, unbroken):
    before = model_bytes(unbroken)
    again = finish(capture, unbroken)
    assert again.returncode == 0
    assert "already trained" in again.stdout
    assert model_bytes(unbroken) == before


def test_ten_kills_change_no_bit(capture, unbroken, tmp_path):
    """Each just before something happens to a file of the run: a state is begun, renamed, removed, read again."""
    run, moments = tmp_path / "run", random.Random(7)
    for _ in range(10):
        with begun(*command(capture, run), pause_at=("*/coarse/*", moments.randrange(1, 30))) as process:
            process.wait_until_paused()
            process.send_signal(signal.SIGKILL)
            assert process.finished().returncode == -signal.SIGKILL
    done = finish(capture, run)
    assert done.returncode == 0, done.stderr
    assert "continuing at iteration" in done.stdout
    assert model_bytes(run) == model_bytes(unbroken)


def take_terminal(name: str) -> None:
    """Let this process begin a session at a terminal, where its errors go."""
    os.setsid()
    os.dup2(os.open(name, os.O_RDWR), 2)


def stop(arguments: list[str], iteration: int, how: signal.Signals | None) -> CompletedProcess[str]:
    """Stop a run that is about to save: by a signal, or because its terminal closes."""
    inside, outside = os.openpty()
    prepare = None if how else partial(take_terminal, os.ttyname(outside))
    with begun(*arguments, pause_at=(f"*/checkpoints/{iteration:08d}.json", 1), prepare=prepare) as process:
        process.wait_until_paused()
        if how:
            process.send_signal(how)
        os.close(outside)
        os.close(inside)
        return process.finished()


def test_a_stopped_run_saves_and_continues(capture, unbroken, tmp_path):
    """By each signal, and last as its terminal closes: four times over, and to the same bits."""
    run = tmp_path / "run"
    for iteration, how in zip((20, 40, 60, 80), (*STOP_SIGNALS, None), strict=True):
        stopped = stop(command(capture, run), iteration, how)
        assert stopped.returncode == 130, how
        assert ("The same command continues" in stopped.stderr) == (how is not None)
        status = json.loads((run / "coarse/status.json").read_text())
        assert (status["state"], status["iteration"]) == ("stopped", iteration)
        assert iteration == 20 or f"continuing at iteration {iteration - 20}" in stopped.stdout
    done = finish(capture, run)
    assert "continuing at iteration 80" in done.stdout
    assert model_bytes(run) == model_bytes(unbroken)


def test_a_truncated_state_falls_back_and_says_so(capture, unbroken, tmp_path):
    run = tmp_path / "run"
    with begun(*command(capture, run), pause_at=("*/checkpoints/00000060.json", 1)) as process:
        process.wait_until_paused()
        process.send_signal(signal.SIGKILL)
        process.finished()
    newest = sorted((run / "coarse/checkpoints").glob("*.json"))[-1].with_suffix(".safetensors")
    os.truncate(newest, newest.stat().st_size // 3)
    done = finish(capture, run)
    assert done.returncode == 0, done.stderr
    assert newest.name in done.stdout.replace("\n", "")
    assert "damaged" in done.stdout
    assert "continuing at iteration 40" in done.stdout
    assert model_bytes(run) == model_bytes(unbroken)


def test_other_settings_are_refused_with_the_difference(capture, unbroken):
    done = finish(capture, unbroken, "--seed", "3")
    assert done.returncode == 1
    assert "--seed: 0 -> 3" in done.stderr
    assert "Traceback" not in done.stderr


def copy_of(run: Path, target: Path) -> Path:
    shutil.copytree(run, target, ignore=shutil.ignore_patterns(".lock"))
    return target


@pytest.mark.parametrize("seed", range(12))
def test_a_run_with_flipped_bits_ends_in_an_error_or_in_the_same_model(unbroken, tmp_path, seed):
    """Whatever file of a run is damaged: a clear error, or the right result; never a crash or a wrong one."""
    moments = random.Random(seed)
    run = copy_of(unbroken, tmp_path / "run")
    victim = run / ["config.yaml", "coarse/status.json", "coarse/model.safetensors"][seed % 3]
    data = bytearray(victim.read_bytes())
    if moments.random() < 0.4:
        data = data[: moments.randrange(len(data))]
    else:
        data[moments.randrange(len(data))] ^= 1 << moments.randrange(8)
    victim.write_bytes(data)
    good = open_run(unbroken)
    try:
        opened = open_run(run)
    except VdgsError as error:
        told = str(error)
    else:
        told = ""
        assert [view.name for view in opened.capture.test_views] == [view.name for view in good.capture.test_views]
        assert opened.model.background == good.model.background
        for name, tensor in good.model.anchors.tensors().items():
            assert torch.equal(opened.model.anchors.tensors()[name], tensor)
    assert victim.name != "model.safetensors" or victim.name in told


def test_a_flipped_weight_is_noticed(unbroken, tmp_path):
    run = copy_of(unbroken, tmp_path / "run")
    model = run / "coarse/model.safetensors"
    data = bytearray(model.read_bytes())
    data[-3] ^= 1
    model.write_bytes(data)
    with pytest.raises(VdgsError, match=r"model\.safetensors.*Delete it and run"):
        open_run(run)


def test_a_deleted_model_is_rebuilt_from_the_last_state(capture, unbroken, tmp_path):
    run = copy_of(unbroken, tmp_path / "run")
    (run / "coarse/model.safetensors").unlink()
    done = finish(capture, run)
    assert done.returncode == 0, done.stderr
    assert model_bytes(run) == model_bytes(unbroken)


@pytest.mark.parametrize("change", ["photograph", "points"])
def test_a_capture_that_changed_is_refused(capture, unbroken, tmp_path, change):
    other = tmp_path / "capture"
    shutil.copytree(capture, other)
    run = copy_of(unbroken, tmp_path / "run")
    for file in ("config.yaml", "capture.json"):
        text = (run / file).read_text()
        (run / file).write_text(text.replace(str(capture), str(other)))
    assert len(open_run(run).capture.views) == 12
    if change == "photograph":
        photograph = next((other / "images").iterdir())
        assert cv2.imwrite(str(photograph), cv2.imread(str(photograph)) // 2)
    else:
        write_colmap(other, tiny_scene(points=300))
    with pytest.raises(VdgsError, match=r"is not the capture that.*changed"):
        open_run(run)
    done = finish(other, run)
    assert done.returncode == 1
    assert "is not the capture that" in done.stderr


def test_a_disk_that_is_full_is_said_and_the_same_command_continues(capture, unbroken, tmp_path):
    """A limit on the size of files stands in for the disk: the states of this run do not fit."""
    run = tmp_path / "run"
    done = vdgs(*command(capture, run), prepare=partial(limit_files, 60_000))
    assert done.returncode == 1
    assert "cannot be written" in done.stderr
    assert "Traceback" not in done.stderr
    again = finish(capture, run)
    assert again.returncode == 0, again.stderr
    assert model_bytes(run) == model_bytes(unbroken)


def test_a_photograph_deleted_on_the_way_loses_nothing(capture, unbroken, tmp_path):
    other = tmp_path / "capture"
    shutil.copytree(capture, other)
    run = tmp_path / "run"
    tight = command(other, run, "--image-cache-gb", "1e-6")
    with begun(*tight, pause_at=("*/checkpoints/00000010.json", 1)) as process:
        process.wait_until_paused()
        photograph = sorted((other / "images").iterdir())[5]
        photograph.rename(tmp_path / photograph.name)
        process.go_on()
        failed = process.finished()
    assert failed.returncode == 1
    assert photograph.name in failed.stderr
    assert json.loads((run / "coarse/status.json").read_text())["state"] == "failed"
    (tmp_path / photograph.name).rename(photograph)
    done = finish(other, run)
    assert done.returncode == 0, done.stderr
    ours, theirs = (AnchorModel.load(r / "coarse/model.safetensors").anchors.tensors() for r in (run, unbroken))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_few_iterations_are_a_run_too(capture, tmp_path):
    arguments = command(capture, tmp_path / "run")
    arguments[arguments.index("100")] = "3"
    done = vdgs(*arguments)
    assert done.returncode == 0, done.stderr
    assert "no anchor will grow" in done.stdout


def test_evaluation_and_renders_of_a_run(unbroken, tmp_path):
    run = copy_of(unbroken, tmp_path / "run")
    measured = vdgs("eval", run)
    assert measured.returncode == 0, measured.stderr
    assert "LPIPS is null" in measured.stdout
    metrics = json.loads((run / "coarse/evaluation/metrics.json").read_text())
    assert 15 < metrics["psnr"] < 60
    assert metrics["lpips_vgg"] is None
    assert metrics["n_anchors"] > 100
    assert sum(bin["pixels"] for bin in metrics["by_visibility"]) == 2 * 64 * 48
    without = vdgs("eval", run, "--views", "off-path")
    assert without.returncode == 1
    assert "brings no photographs from where nobody flew" in without.stderr
    test_files = {path: path.read_bytes() for path in (run / "coarse/evaluation").rglob("*.png")}
    assert vdgs("eval", run, "--views", "training").returncode == 0
    training = json.loads((run / "coarse/evaluation_training/metrics.json").read_text())
    assert (metrics["test_views"], training["training_views"]) == (2, 10)
    assert training["psnr"] > metrics["psnr"]
    assert {path: path.read_bytes() for path in test_files} == test_files
    for kind in ("rgb", "depth", "visibility"):
        assert vdgs("render", run, "--output", tmp_path / kind, "--mode", kind, "--no-colorbar").returncode == 0
        pictures = [cv2.imread(str(path)) for path in sorted((tmp_path / kind).glob("*.png"))]
        assert [picture.shape for picture in pictures] == [(48, 64, 3)] * 2
        assert min(float(picture.std()) for picture in pictures) > 3
    again = vdgs("render", run, "--output", tmp_path / "depth", "--mode", "depth", "--raw", "--views", "train")
    assert again.returncode == 0, again.stderr
    assert (
        "10 frames of 64x48 px, each with its numbers as .npy, in place of 2 files of an earlier render" in again.stdout
    )
    assert len(list((tmp_path / "depth").glob("*.png"))) == len(list((tmp_path / "depth").glob("*.npy"))) == 10
    for numbers in (np.load(file) for file in (tmp_path / "depth").glob("*.npy")):
        assert (numbers.dtype, numbers.shape) == (np.float32, (48, 64))
        assert 7 < np.nanmedian(numbers) < 13  # the flight is 10 above the ground
    assert vdgs("render", run, "--output", tmp_path / "alpha", "--mode", "alpha").returncode == 0
    tall = cv2.imread(str(next((tmp_path / "alpha").glob("*.png"))))
    assert tall.shape[0] > 48
    assert tall[:48].mean() > 180
    assert vdgs("render", run, "--output", tmp_path / "alpha", "--mode", "alpha", "--min-visibility", 6).returncode == 0
    assert cv2.imread(str(next((tmp_path / "alpha").glob("*.png"))))[:48].mean() < tall[:48].mean() - 5
    film = ("render", run, "--output", tmp_path / "f.mp4", "--views", "orbit", "--seconds", "0.5")
    assert vdgs(*film).returncode == 0
    assert (tmp_path / "f.mp4").stat().st_size > 1000
