"""What the record of an evaluation vouches for: figures of the model that was measured, on the photographs it was."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import MethodConfig, ModelConfig, TrainConfig
from vdgs.evaluation.measured_as import is_evaluated
from vdgs.model.lod_format import TREE_FILE
from vdgs.pipeline import evaluate_stage as stage
from vdgs.pipeline.train_coarse import train_coarse
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.lod_status import lod_folder
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


def shards_folder(context: RunContext, **asked: Any) -> Path:
    """Where shards leave what they have measured: figures of anything else lie elsewhere."""
    request = stage.EvaluationRequest(path=context.run.path, which="coarse", **asked)
    return stage._Evaluation.create(request).job(context.capture).folder


def test_figures_of_off_path_views_that_were_replaced_are_not_joined_and_not_kept(trained):
    write_off_path(trained.capture.root, 32)
    context = RunContext.from_path(trained.run.path)
    measure(context)
    of_test, of_street = shards_folder(context), shards_folder(context, views="off-path")
    photograph = context.capture.off_path_views[0].image_path
    content = photograph.read_bytes()
    photograph.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))  # another of the same size
    os.utime(photograph, ns=(0, 0))
    assert not stage.is_off_path_measured(context, "coarse")
    assert shards_folder(context, views="off-path") != of_street
    assert shards_folder(context) == of_test


def test_figures_through_a_tree_are_not_joined_with_those_of_another(trained):
    folder = lod_folder(trained.run)
    folder.reset_unless("key")
    (folder.path / TREE_FILE).write_bytes(b"nodes")
    found = [shards_folder(trained), shards_folder(trained, lod_error=1.0), shards_folder(trained, lod_error=2.0)]
    (folder.path / TREE_FILE).write_bytes(b"other nodes")
    found.append(shards_folder(trained, lod_error=1.0))
    folder.reset_unless("of other settings")
    (folder.path / TREE_FILE).write_bytes(b"other nodes")
    found.append(shards_folder(trained, lod_error=1.0))
    assert len(set(found)) == len(found)
    assert shards_folder(trained, lod_error=1.0) == found[-1]
