"""What the record of an evaluation vouches for: figures of the model that was measured, on the photographs it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import MethodConfig, ModelConfig, TrainConfig
from vdgs.evaluation.measured_as import is_evaluated
from vdgs.pipeline import evaluate_stage as stage
from vdgs.pipeline.train_coarse import train_coarse
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.run_context import RunContext
from vdgs.system.atomic_files import read_json

pytestmark = pytest.mark.slow

QUIET = Console(quiet=True)


@pytest.fixture
def trained(tmp_path) -> RunContext:
    method = MethodConfig(TrainConfig(iterations=2, model=ModelConfig(num_offsets=2)))
    write_colmap(tmp_path / "place", tiny_scene(width=32, height=24, points=80))
    context = create_or_resume_run(tmp_path / "place", tmp_path / "run", CaptureOptions(up="z"), method)
    train_coarse(context, CheckpointOptions(), QUIET)
    return context


def measure(context: RunContext) -> None:
    stage.evaluate_stage(context, stage.EvaluationRequest(path=context.run.path, which="coarse"), QUIET)


def test_figures_of_a_model_that_was_made_anew_meanwhile_are_out_of_date(trained, monkeypatch):
    run, evaluate_run = trained.run, stage.evaluate_run
    measured = run.coarse.status().model_id

    def made_anew_after(*given):
        evaluate_run(*given)
        run.coarse.set_status(replace(run.coarse.status(), model_id="another"))

    monkeypatch.setattr(stage, "evaluate_run", made_anew_after)
    measure(trained)
    assert read_json(run.coarse.path / "evaluation" / "status.json")["model"] == measured
    assert not is_evaluated(run, "coarse", None, 4)


def write_off_path(capture: Path, width: int) -> None:
    cameras = tiny_scene(columns=1, rows=2, width=width, height=width * 3 // 4)
    street = {f"street/{name}": camera for name, camera in cameras.cameras.items()}
    write_colmap(capture / "off_path", replace(cameras, cameras=street), images=".")


def test_photographs_from_where_nobody_flew_are_measured_when_they_come_or_change(trained):
    run, capture = trained.run, trained.capture.root
    measure(trained)
    assert stage.is_off_path_measured(trained, "coarse")  # there are none
    for width in (32, 64):
        write_off_path(capture, width)
        context = RunContext.from_path(run.path)
        assert not stage.is_off_path_measured(context, "coarse")
        measure(context)
        assert stage.is_off_path_measured(context, "coarse")
