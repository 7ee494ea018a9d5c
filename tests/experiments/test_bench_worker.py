"""The process of one run of a bench: how it trains, and what it notes of time."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.bench import worker
from experiments.bench.definitions import CLOCK, RECORD_FILE
from vdgs.pipeline import train_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json, write_json


@pytest.fixture
def job(tmp_path: Path) -> worker.BenchJob:
    return worker.BenchJob(tmp_path, {}, {}, ("coarse",), tmp_path, None, "key", None, 4, 2)


def noted(job: worker.BenchJob, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """The record of a run whose stage takes 2 seconds and draws figures for 5 more."""
    now = SimpleNamespace(monotonic=lambda: seconds[0])
    seconds = [0.0]

    def stage(at: SimpleNamespace) -> None:
        seconds[0] += 2.0
        with at.context.drawing_figures():
            seconds[0] += 5.0

    monkeypatch.setattr(worker, "time", now)
    monkeypatch.setattr("vdgs.runs.run_context.time", now)
    monkeypatch.setattr(worker, "_opened", lambda job: nullcontext(RunContext(RunFolder(job.output))))
    monkeypatch.setitem(worker.STAGES, "coarse", stage)
    monkeypatch.setattr("vdgs.kernels.configure_threads", lambda count: None)
    worker.run_job(job)
    return read_json(job.output / RECORD_FILE)


def test_figures_for_people_are_no_time_of_a_method(job, monkeypatch):
    record = noted(job, monkeypatch)
    assert record["seconds"] == {"coarse": 2.0}
    assert record["clock"] == CLOCK


@pytest.mark.parametrize(("key", "seconds"), [("key", 12.0), ("another", 2.0)])
def test_a_run_that_began_by_an_older_clock_keeps_it(job, monkeypatch, key, seconds):
    write_json(job.output / RECORD_FILE, {"state": "running", "key": key, "seconds": {"coarse": 10.0}})
    record = noted(job, monkeypatch)
    assert record["seconds"] == {"coarse": seconds}
    assert record["clock"] == 1


def test_blocks_train_one_after_another_on_all_threads(job, monkeypatch):
    asked = []
    monkeypatch.setattr(train_blocks, "train_blocks", lambda *given: asked.append(given[2]))
    worker.STAGES["blocks"](SimpleNamespace(job=replace(job, threads=8), context=None, console=None))
    assert asked == [1]
