"""What moves, verb by verb: masks after the coarse stage, used by blocks and shown by the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from support.captures import tiny_scene, write_colmap
from support.small_pipeline import BLOCK, CUT, SETTINGS, train_coarse, vdgs
from vdgs.captures.capture_metadata import capture_fingerprint
from vdgs.captures.image_cache import load_image
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import OrthoRequest, RunRequest
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import BlockConfig, MethodConfig
from vdgs.errors import CaptureError, RunError, VdgsError
from vdgs.evaluation.moving_pixels import MIN_MOVING_SHARE, SAMPLED_PHOTOGRAPHS
from vdgs.model.anchor_model import AnchorModel
from vdgs.ops.api import train
from vdgs.pipeline import find_motion
from vdgs.pipeline.run_estimate import Scene, _other_times
from vdgs.pipeline.time_estimate import MOTION_VIEW_SECONDS, MOTION_VIEW_STEPS
from vdgs.pipeline.train_block import train_block
from vdgs.rendering.ortho.ortho_plan import OrthoPlan
from vdgs.runs.motion_masks import with_motion_masks
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import MOTION_FILE, RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.run_status import get_run_status
from vdgs.runs.stage_keys import stage_keys
from vdgs.system.processor_time import Cost

pytestmark = pytest.mark.slow

BOX = np.s_[18:30, 20:44]


@pytest.mark.slow
def test_blocks_leave_out_what_moves(tmp_path, capsys, monkeypatch):
    capture, run = tmp_path / "capture", tmp_path / "run"
    write_colmap(capture, tiny_scene())
    painted = capture / "images" / "frame_005.png"
    picture = cv2.imread(str(painted))
    picture[BOX] = (20, 250, 250)
    cv2.imwrite(str(painted), picture)
    (capture / "masks").mkdir()
    own = np.full(picture.shape[:2], 255, np.uint8)
    own[:6] = 0
    cv2.imwrite(str(capture / "masks" / "frame_005.png"), own)
    vdgs("train-coarse", capture, "--output", run, "--up", "z", *SETTINGS, "--iterations", "60")
    context, config = RunContext.from_path(run), run / "config.yaml"
    still = context.run.keys()
    monkeypatch.setattr(find_motion, "MIN_MOVING_SHARE", 0.1)
    with pytest.raises(RunError, match=r"vdgs visibility .*--block\.mask-moving off"):  # not known yet
        with_motion_masks(context.run, context.capture)
    assert with_motion_masks(context.run, context.capture, needed=False) is context.capture
    vdgs("visibility", run)
    sampled = json.loads((run / MOTION_FILE).read_text())
    assert not sampled["masked"]
    assert MIN_MOVING_SHARE < sampled["share"] < 0.03
    assert with_motion_masks(context.run, context.capture) is context.capture
    assert context.run.keys() == still
    assert sorted(file.name for file in (run / MOTION_FILE).parent.iterdir()) == ["key", "motion.json"]
    vdgs("visibility", run)
    assert "motion.json: already there" in capsys.readouterr().out.replace("\n", "")

    config.write_text(config.read_text().replace("mask_moving: auto", "mask_moving: 'on'"))
    context = RunContext.from_path(run)
    assert context.run.keys().blocks != still.blocks
    with pytest.raises(RunError, match="vdgs visibility"):
        with_motion_masks(context.run, context.capture)
    vdgs("visibility", run)
    record = json.loads((run / MOTION_FILE).read_text())
    assert len(record["photographs"]) == len(context.capture.train_views)
    assert not (run / MOTION_FILE).with_name("residuals").exists()

    views = {view.name: view for view in with_motion_masks(context.run, context.capture).views}
    keep = load_image(views["frame_005.png"]).mask.numpy()
    assert not keep[:6].any()
    assert keep[BOX].mean() < 0.2
    assert keep[6:].mean() > 0.7
    request = OrthoRequest(run=run, detail_from_images=True)
    masks = {
        asked: OrthoPlan.of(replace(request, detail_from_images=asked), run, "coarse", None, context.capture)
        for asked in (True, False)
    }
    of = {asked: {v.name: v.mask_path for v in plan.nadir_camera.capture.views} for asked, plan in masks.items()}
    assert of[True] == {name: view.mask_path for name, view in views.items()} != of[False]
    test_view = context.capture.test_views[0]
    assert views[test_view.name].mask_path == test_view.mask_path

    vdgs("partition", run, "--blocks", "1")
    vdgs("train-blocks", run, "--block", "0", *BLOCK)
    trained = AnchorModel.load(context.run.block(0).model).metadata.capture
    assert trained["fingerprint"] == capture_fingerprint(context.capture)  # of its own masks, not of these
    vdgs("report", run)
    assert "What moves" in (run / "report.html").read_text()
    config.write_text(config.read_text().replace("mask_moving: 'on'", "mask_moving: auto"))
    # `auto` goes by its sample, though `on` made masks.
    context = RunContext.from_path(run)
    assert with_motion_masks(context.run, context.capture) is context.capture
    vdgs("visibility", run)
    assert json.loads((run / MOTION_FILE).read_text()) == sampled
    assert sorted(file.name for file in (run / MOTION_FILE).parent.iterdir()) == ["key", "motion.json"]
    monkeypatch.setattr(find_motion, "MIN_MOVING_SHARE", MIN_MOVING_SHARE)
    (run / MOTION_FILE).unlink()
    vdgs("visibility", run)
    assert json.loads((run / MOTION_FILE).read_text()) == record | {"enough": True}
    assert context.run.keys().blocks == RunContext.from_path(run).run.keys().blocks
    config.write_text(config.read_text().replace("mask_moving: auto", "mask_moving: 'off'"))
    vdgs("visibility", run)
    assert not (run / MOTION_FILE).parent.exists()


def test_the_cut_finds_what_moves_before_blocks_are_trained(tmp_path, monkeypatch):
    capture, run = tmp_path / "capture", RunFolder(tmp_path / "run")
    write_colmap(capture, tiny_scene(columns=3, rows=2, width=32, height=24, points=80))
    train_coarse(capture, run.path)
    monkeypatch.setattr(find_motion, "MIN_MOVING_SHARE", 0.0)
    vdgs("partition", run.path, *CUT)
    cut = run.keys()
    assert json.loads(run.motion_file.read_text())["enough"]
    assert get_run_status(run).of("visibility").state == "done"
    assert not get_run_status(run).next_command().startswith("vdgs visibility")
    vdgs("visibility", run.path)
    assert run.keys() == cut
    run.motion_file.unlink()
    vdgs("partition", run.path)  # to look at a cut, as of a run of before, searches nothing
    assert not run.motion_file.exists()
    with pytest.raises(RunError, match="vdgs visibility"):
        train_block(RunContext.from_path(run.path), 0, CheckpointOptions(), Console(quiet=True))
    assert not run.block(0).has_output()


def test_the_setting_counts_by_what_it_does():
    plain = RunSettings.create("/somewhere", CaptureOptions(), MethodConfig())
    on = stage_keys(replace(plain, block=BlockConfig(mask_moving="on")))
    still, found = stage_keys(plain), {"key": stage_keys(plain).visibility, "masked": True, "enough": True}
    assert still == stage_keys(replace(plain, block=BlockConfig(mask_moving="off")), motion=found)
    assert still == stage_keys(plain, motion=found | {"key": ""})
    assert still == stage_keys(plain, motion=found | {"enough": False})  # masks that `on` asked for
    assert on == stage_keys(plain, motion=found)
    assert (still.coarse, still.assignment) == (on.coarse, on.assignment)
    assert still.blocks != on.blocks


def test_the_time_of_finding_what_moves_is_estimated():
    step, scene = Cost(2.0, 3.0), Scene(None, [None] * 30, 2, 100)
    request = RunRequest(capture=Path("c"), output=Path("r"))
    took = {asked: _other_times(scene, step, request, asked)["motion"].seconds for asked in ("off", "auto", "on")}
    assert took["off"] == 0
    assert took["auto"] == pytest.approx(30 * 2.0 * MOTION_VIEW_STEPS + SAMPLED_PHOTOGRAPHS * MOTION_VIEW_SECONDS)
    assert took["on"] == pytest.approx(30 * (2.0 * MOTION_VIEW_STEPS + MOTION_VIEW_SECONDS))


def test_training_in_memory_has_no_place_for_masks(tmp_path):
    with pytest.raises(VdgsError, match="run_dir"):
        train(tmp_path, MethodConfig(block=BlockConfig(mask_moving="on")))


def test_masks_of_what_moves_are_no_folder(tmp_path):
    write_colmap(tmp_path, tiny_scene())
    with pytest.raises(CaptureError, match=r"--block\.mask-moving on"):
        load_capture(tmp_path, CaptureOptions(masks="auto"))
