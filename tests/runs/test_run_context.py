"""What a command reads of a run: the capture once, each model once while stages hand it on."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from support.captures import tiny_scene, write_colmap
from support.clusters import copy_run
from support.commands import CommandsHere, small_figures
from vdgs.captures import loading
from vdgs.cli.main import main
from vdgs.distributed import backend_selection
from vdgs.distributed.executor import Task, TaskListener, TaskResult
from vdgs.errors import VdgsError
from vdgs.model.anchor_model import AnchorModel
from vdgs.pipeline import image_size, time_estimate
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder

pytestmark = pytest.mark.slow  # whole reconstructions, runs or trainings

SETTINGS = (
    "--preset", "laptop", "--iterations", "12", "--model.num-offsets", "2", "--densify.start", "50", "--no-ortho",
    "--blocks", "2", "--assignment.min-cameras", "3", "--block.iterations", "6", "--quiet",
)  # fmt: skip


class Reads:
    """Counts what is read, by the process that would read it: the driver or one of its tasks."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.process = "driver"
        self.captures, self.models = Counter[str](), Counter[tuple[str, str]]()
        read_source, load_model = loading.read_source, AnchorModel.load

        def read_capture(*given):
            self.captures[self.process] += 1
            return read_source(*given)

        def read_model(path: Path) -> AnchorModel:
            self.models[self.process, path.parent.name] += 1
            return load_model(path)

        monkeypatch.setattr(loading, "read_source", read_capture)
        monkeypatch.setattr(AnchorModel, "load", read_model)
        reads = self

        class TasksHere(CommandsHere):
            def run(self, tasks: Sequence[Task], listener: TaskListener) -> list[TaskResult]:
                outcomes = []
                for task in tasks:
                    reads.process = task.name
                    outcomes += super().run([task], listener)
                reads.process = "driver"
                return outcomes

        monkeypatch.setattr(backend_selection, "LocalExecutor", TasksHere)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Reads:
    return Reads(monkeypatch)


def command(*arguments: object) -> None:
    with small_figures(), pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    assert ended.value.code == 0


@pytest.mark.parametrize("smaller", [False, True])
def test_one_run_reads_its_capture_once_and_each_block_once(tmp_path, reads, monkeypatch, smaller):
    """Also where the run takes a smaller size of the photographs than the capture has."""
    write_colmap(tmp_path / "capture", tiny_scene(columns=3, rows=2, width=32, height=24, points=80))
    monkeypatch.setattr(time_estimate, "MAX_TIMED_SECONDS", 0.0)
    if smaller:
        monkeypatch.setattr(image_size, "MIN_SIDE", 1)
        monkeypatch.setattr(image_size, "MAX_SECONDS", 0.0)
        monkeypatch.setattr(image_size, "DOWNSCALES", (1, 2))
    command("run", tmp_path / "capture", "--output", tmp_path / "run", *SETTINGS)
    assert reads.captures == {"driver": 1, "block 00": 1, "block 01": 1}
    assert (RunFolder(tmp_path / "run").settings().capture.downscale > 1) == smaller
    # The driver holds no model while blocks train: it reads the coarse one again to merge.
    assert (reads.models["driver", "coarse"], reads.models["driver", "merged"]) == (2, 1)
    assert [reads.models[f"block {index:02d}", "coarse"] for index in range(2)] == [1, 1]


def test_a_stage_alone_reads_a_capture_that_moved_once(uncut, tmp_path, reads):
    run = copy_run(uncut, tmp_path / "run")
    shutil.copytree(uncut.parent / "capture", tmp_path / "moved")
    command("visibility", run, "--capture", tmp_path / "moved", "--quiet")
    assert reads.captures == {"driver": 1}
    assert RunContext.from_path(run).capture.root == tmp_path / "moved"


def test_a_model_is_read_once_until_it_is_released_or_its_file_is_another(uncut, tmp_path, reads):
    context = RunContext.from_path(copy_run(uncut, tmp_path / "run"))
    file = context.run.coarse.model
    first, count = context.open_model("coarse"), lambda: reads.models["driver", "coarse"]
    assert context.open_model("best").model.anchors.positions is first.model.anchors.positions
    assert context.open_model("coarse", torch.device("cpu")).capture is first.capture
    assert count() == 1
    context.release_models("merged")
    context.open_model("coarse")
    assert count() == 1
    context.release_models()
    context.open_model("coarse")
    assert count() == 2
    file.write_bytes(file.read_bytes()[:-1] + b"\0")
    with pytest.raises(VdgsError, match="its checksum does not agree"):
        context.open_model("coarse")
    assert count() == 3
