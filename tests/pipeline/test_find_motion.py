"""`--masks auto`, verb by verb: masks after the coarse stage, used by blocks and shown by the report."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.captures import tiny_scene, write_colmap
from support.small_pipeline import BLOCK, SETTINGS, vdgs
from vdgs.captures.image_cache import load_image
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import OrthoRequest, RunRequest
from vdgs.config.method import MethodConfig
from vdgs.errors import RunError, VdgsError
from vdgs.ops.api import train
from vdgs.pipeline.run_estimate import Scene, _other_times
from vdgs.pipeline.time_estimate import MOTION_VIEW_SECONDS, MOTION_VIEW_STEPS
from vdgs.rendering.ortho.ortho_plan import OrthoPlan
from vdgs.runs.motion_masks import MOTION_FILE, with_motion_masks
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_settings import RunSettings
from vdgs.runs.stage_keys import stage_keys
from vdgs.system.processor_time import Cost

BOX = np.s_[18:30, 20:44]


@pytest.mark.slow
def test_blocks_leave_out_what_moves(tmp_path, capsys):
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
    vdgs("train-coarse", capture, "--output", run, "--up", "z", "--masks", "auto", *SETTINGS, "--iterations", "60")
    context = RunContext.from_path(run)
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

    capsys.readouterr()
    vdgs("visibility", run)
    assert "motion.json: already there" in capsys.readouterr().out.replace("\n", "")
    vdgs("partition", run, "--blocks", "1")
    vdgs("train-blocks", run, "--block", "0", *BLOCK)
    vdgs("report", run)
    assert "What moves" in (run / "report.html").read_text()
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("masks: auto", "masks: masks"))
    vdgs("visibility", run)
    assert not (run / MOTION_FILE).parent.exists()


def test_masks_of_what_moves_are_of_the_blocks_alone():
    plain = RunSettings.create("/somewhere", CaptureOptions(), MethodConfig())
    before, after = stage_keys(plain), stage_keys(replace(plain, capture=CaptureOptions(masks="auto")))
    assert (before.coarse, before.assignment) == (after.coarse, after.assignment)
    assert before.blocks != after.blocks


def test_the_time_of_finding_what_moves_is_estimated():
    step, scene = Cost(2.0, 3.0), Scene(None, [None] * 10, 2, 100)
    took = {}
    for masks in ("masks", "auto"):
        options = CaptureOptions(masks=masks)
        times = _other_times(scene, step, RunRequest(capture=Path("c"), output=Path("r"), options=options))
        took[masks] = times["motion"].seconds
    assert took["masks"] == 0
    assert took["auto"] == pytest.approx(10 * (2.0 * MOTION_VIEW_STEPS + MOTION_VIEW_SECONDS))


def test_training_in_memory_has_no_place_for_masks(tmp_path):
    with pytest.raises(VdgsError, match="run_dir"):
        train(tmp_path, capture_options=CaptureOptions(masks="auto"))
