"""What the coarse stage hands on: a model with anchors or none at all, on whatever device it is opened."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from support.fake_device import CARD, pretended_card
from support.hand_made_models import model_at
from vdgs import kernels
from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import DensifyConfig, InitConfig, MethodConfig, ModelConfig, TrainConfig
from vdgs.errors import RunError
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.pipeline.count_visibility import count_run_visibility
from vdgs.pipeline.train_coarse import (
    build_coarse_problem,
    initial_coarse_state,
    open_training_images,
    train_coarse,
)
from vdgs.runs.create_or_resume import create_or_resume_run
from vdgs.runs.open_run import open_run
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import get_run_status
from vdgs.runs.stage_folder import StatusRecord
from vdgs.runs.visibility_store import load_or_count_visibility
from vdgs.system.atomic_files import write_json
from vdgs.system.tensors import file_id

UP, QUIET = CaptureOptions(up="z"), Console(quiet=True)
#: Some steps, at the end of which all that was seen is taken for transparent.
LAST = DensifyConfig(
    every=20, stats_start=0, start=20, num_levels=0, prune_opacity=1e6, prune_view_fraction=0.0, stop_fraction=1.0
)  # fmt: skip
METHOD = MethodConfig(
    TrainConfig(
        iterations=20,
        model=ModelConfig(num_offsets=2),
        init=InitConfig(fill_gaps=False),
        densify=LAST,
        swa_fraction=0.0,
    )
)


def begin(folder: Path, method: MethodConfig, redo: bool | None = None) -> tuple[RunFolder, Capture]:
    context = create_or_resume_run(folder / "place", folder / "run", UP, method, overwrite=redo)
    return context.run, context.capture


def train(run: RunFolder, capture: Capture) -> None:
    train_coarse(RunContext(run, capture), CheckpointOptions(), QUIET)


def finished(run: RunFolder, capture: Capture, model: AnchorModel) -> None:
    """A coarse stage that is done with a model."""
    write_json(run.capture_file, capture_metadata(capture))
    run.coarse.reset_unless(run.keys().coarse)
    metadata = ModelMetadata(key=run.keys().coarse, capture=capture_metadata(capture))
    replace(model, metadata=metadata).save(run.coarse.model)
    count = len(model.anchors)
    run.coarse.set_status(StatusRecord(state="done", iteration=6, anchors=count, model_id=file_id(run.coarse.model)))


def test_training_that_leaves_no_anchors_is_not_done_and_says_what_to_change(tmp_path):
    scene = tiny_scene()
    below = ((scene.points[:, :2] > 0) & (scene.points[:, :2] < (9, 6))).all(axis=1)  # of the flight: all are seen
    write_colmap(tmp_path / "place", replace(scene, points=scene.points[below], colors=scene.colors[below]))
    run, capture = begin(tmp_path, METHOD)
    for _ in range(2):  # the same command says the same
        with pytest.raises(RunError, match=r"coarse: .*no anchors(?s:.*)--densify\.prune-opacity(?s:.*)--overwrite"):
            train(run, capture)
        assert not run.coarse.model.exists()
        assert get_run_status(run).of("coarse").state == "failed"
    kept = replace(METHOD, training=replace(METHOD.training, densify=replace(LAST, prune_opacity=0.0)))
    with pytest.raises(RunError, match="--overwrite"):
        begin(tmp_path, kept, redo=False)
    train(*begin(tmp_path, kept, redo=True))  # as it advised
    assert run.coarse.is_done(run.keys().coarse)


def test_a_model_without_anchors_of_an_earlier_version_is_refused_too(tmp_path):
    write_colmap(tmp_path / "place", tiny_scene())
    run, capture = begin(tmp_path, METHOD)
    finished(run, capture, model_at(torch.zeros(0, 3).numpy()))
    with pytest.raises(RunError, match="no anchors"):
        train(run, capture)
    with pytest.raises(RunError, match="no anchors"):
        count_run_visibility(RunContext(run), QUIET)


def test_visibility_that_is_counted_on_a_card_is_handed_on_in_main_memory(tmp_path, monkeypatch):
    """As `vdgs partition --device cuda` does, where nothing has counted it before."""
    monkeypatch.setenv(kernels.KERNELS_ENV_VAR, "torch_ref")  # no driver stands in for the card's
    write_colmap(tmp_path / "place", tiny_scene())
    run, capture = begin(tmp_path, METHOD)
    finished(run, capture, model_at([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [90.0, 0.0, 0.0]]))
    with pretended_card():
        counted = load_or_count_visibility(open_run(run.path, "coarse", CARD)).numpy()
        kept = load_or_count_visibility(open_run(run.path, "coarse", CARD)).numpy()
    assert counted[2] == 0 < counted[0]
    assert kept.tolist() == counted.tolist() == load_or_count_visibility(open_run(run.path, "coarse")).tolist()


def test_photographs_that_look_down_have_an_environment_map_only_if_asked_for(tmp_path):
    write_colmap(tmp_path / "place", tiny_scene())
    _, capture = begin(tmp_path, METHOD)
    for choice in ("auto", "off", "envmap"):
        config = replace(METHOD.training, model=ModelConfig(num_offsets=2, background_model=choice))
        with open_training_images(capture, config, 10**7) as images:
            stage, anchors = build_coarse_problem(capture, config, images, "cpu")
            state = initial_coarse_state(anchors, stage, False)
        assert (state.decoder.envmap is None) == (stage.sky_masks is None) == (choice != "envmap")
    plain = torch.tensor(stage.background).expand_as(state.decoder.envmap)
    torch.testing.assert_close(state.decoder.envmap.detach(), plain)
