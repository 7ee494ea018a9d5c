"""The whole pipeline on the reference set of operations (plain torch) beside the native one: what one can, both can."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from support.small_pipeline import COARSE, MERGED, after_the_coarse_stage, psnr, train_coarse, vdgs
from vdgs import kernels
from vdgs.kernels import torch_ref
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.assignment.score_file import load_scores
from vdgs.runs.open_run import open_run
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.visibility_store import get_run_visibility

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("composition")]


@pytest.fixture(scope="module")
def runs(native_small, tmp_path_factory) -> tuple[Path, Path, Path]:
    """A run by the native set; by the reference a coarse stage, and all that follows the native coarse stage."""
    folder = tmp_path_factory.mktemp("sets")
    twin, shared = folder / "twin", folder / "shared"
    shutil.copytree(native_small.coarse, shared)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(kernels.KERNELS_ENV_VAR, "torch_ref")
        assert kernels.get_backend(torch.device("cpu")) is torch_ref
        train_coarse(native_small.capture, twin)
        vdgs("eval", twin, "--model", "coarse")
        after_the_coarse_stage(shared)
    return native_small.whole, twin, shared


def test_both_sets_learn_the_place_alike(runs):
    native, twin, shared = runs
    for name, run in ((COARSE, twin), (MERGED, shared)):
        ours, theirs = psnr(native, name), psnr(run, name)
        assert ours > 13  # 12.0 for a plain gray picture
        assert theirs == pytest.approx(ours, abs=0.6)
    before, after = (
        len(AnchorModel.load(shared / name / "model.safetensors").anchors) for name in ("coarse", "merged")
    )
    assert after != before  # blocks have trained and grown
    first = json.loads((twin / "coarse" / "log.jsonl").read_text().splitlines()[0])
    same = json.loads((native / "coarse" / "log.jsonl").read_text().splitlines()[0])
    assert first["loss"] == pytest.approx(same["loss"], rel=0.05)


def test_from_one_coarse_model_both_cut_assign_and_measure_alike(runs):
    native, _, shared = runs
    opened = [open_run(run, "coarse") for run in (native, shared)]
    seen = [get_run_visibility(run, [view.camera for view in run.capture.train_views]) for run in opened]
    assert torch.equal(*seen)
    assert (native / "partition" / "blocks.geojson").read_bytes() == (
        shared / "partition" / "blocks.geojson"
    ).read_bytes()
    ours, theirs = (load_scores(RunFolder(run).partition / "scores.npz") for run in (native, shared))
    np.testing.assert_allclose(theirs.scores.scores, ours.scores.scores, atol=0.02)
    np.testing.assert_array_equal(theirs.scores.visible_anchors, ours.scores.visible_anchors)
    assert psnr(shared, COARSE) == pytest.approx(psnr(native, COARSE), abs=0.01)
