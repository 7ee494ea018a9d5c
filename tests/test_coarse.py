"""The coarse stage as people run it: real processes that are stopped, killed, damaged and continued."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from captures_support import tiny_scene, write_colmap
from vdgs.anchors import AnchorModel
from vdgs.errors import VdgsError

SETTINGS = (
    "--preset", "laptop", "--iterations", "1500", "--save-every", "50", "--anchors.offsets", "3", "--up", "z",
    "--growth.start", "100", "--growth.statistics-from", "50", "--growth.gate", "0.05",
)  # fmt: skip


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    return folder


def command(capture: Path, run: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "vdgs.cli", "coarse", str(capture), "--output", str(run), *SETTINGS, *more]


def finish(capture: Path, run: Path, *more: str) -> subprocess.CompletedProcess:
    return subprocess.run(command(capture, run, *more), capture_output=True, text=True, timeout=120)


def begin(capture: Path, run: Path) -> subprocess.Popen:
    """Start the command and wait until it trains."""
    started = subprocess.Popen(command(capture, run), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    status, before = run / "coarse" / "status.json", time.time()
    while started.poll() is None and not (status.exists() and status.stat().st_mtime >= before - 0.01):
        time.sleep(0.01)
    return started


def model_bytes(run: Path) -> bytes:
    return (run / "coarse" / "model.safetensors").read_bytes()


@pytest.fixture(scope="module")
def unbroken(capture, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("unbroken") / "run"
    done = finish(capture, run)
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
    assert log[-1]["iteration"] == 1500
    assert log[-1]["loss"] < 0.5 * log[0]["loss"]
    status = json.loads((unbroken / "coarse/status.json").read_text())
    assert status["state"] == "done"
    assert AnchorModel.load(unbroken / "coarse/model.safetensors").facts["iterations"] == 1500


def test_a_finished_run_is_not_trained_again(capture, unbroken):
    before = model_bytes(unbroken)
    again = finish(capture, unbroken)
    assert again.returncode == 0
    assert "already trained" in again.stdout
    assert model_bytes(unbroken) == before


def test_ten_kills_change_no_bit(capture, unbroken, tmp_path):
    run, moments = tmp_path / "run", random.Random(7)
    kills = 0
    for _ in range(10):
        process = begin(capture, run)
        time.sleep(moments.uniform(0.0, 0.35))
        kills += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert kills >= 8
    done = finish(capture, run)
    assert done.returncode == 0, done.stderr
    assert model_bytes(run) == model_bytes(unbroken)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_saves_and_continues(capture, unbroken, tmp_path, number):
    run = tmp_path / "run"
    process = begin(capture, run)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "The same command continues" in errors
    assert json.loads((run / "coarse/status.json").read_text())["state"] == "stopped"
    done = finish(capture, run)
    assert "continuing at iteration" in done.stdout
    assert model_bytes(run) == model_bytes(unbroken)


def test_a_truncated_state_falls_back_and_says_so(capture, unbroken, tmp_path):
    run = tmp_path / "run"
    process = begin(capture, run)
    while len(list((run / "coarse/checkpoints").glob("*.json"))) < 2:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    newest = sorted((run / "coarse/checkpoints").glob("*.json"))[-1].with_suffix(".safetensors")
    os.truncate(newest, newest.stat().st_size // 3)
    done = finish(capture, run)
    assert done.returncode == 0, done.stderr
    assert newest.name in done.stdout.replace("\n", "")
    assert "damaged" in done.stdout
    assert model_bytes(run) == model_bytes(unbroken)


def test_other_settings_are_refused_with_the_difference(capture, unbroken):
    done = finish(capture, unbroken, "--seed", "3")
    assert done.returncode == 1
    assert "training.seed: 0 -> 3" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("seed", range(12))
def test_a_run_with_flipped_bits_ends_in_an_error_or_in_the_same_model(capture, unbroken, tmp_path, seed):
    """Whatever file of a run is damaged: a clear error, or the right result; never a crash or a wrong one."""
    from vdgs.evaluation.of_run import open_run

    moments = random.Random(seed)
    run = tmp_path / "run"
    for source in unbroken.rglob("*"):
        if source.is_file() and source.name != ".lock":
            target = run / source.relative_to(unbroken)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read_bytes())
    victims = ["config.yaml", "coarse/status.json", "coarse/model.safetensors"]
    victim = run / victims[seed % 3]
    data = bytearray(victim.read_bytes())
    if moments.random() < 0.5:
        victim.write_bytes(data[: moments.randrange(len(data))])
    else:
        data[moments.randrange(min(len(data), 2000))] ^= 1 << moments.randrange(8)
        victim.write_bytes(data)
    try:
        opened = open_run(run)
    except VdgsError as error:
        told = str(error)
    else:
        told = None
        opened.model.check()
    assert told or victim.name == "model.safetensors" or model_bytes(run) == model_bytes(unbroken)
    assert told is None or victim.name in told or "capture" in told
