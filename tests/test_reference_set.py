"""The whole pipeline on the reference set of operations (plain torch) beside the native one: what one can, both can."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from captures_support import tiny_scene, write_colmap
from vdgs import cli, kernels
from vdgs.kernels import reference
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.assignment.saving import load_scores
from vdgs.runs.folder import RunFolder
from vdgs.runs.opening import open_run
from vdgs.runs.visibility import visibility_of_run

#: As few and as small as lets anchors grow, blocks train and PSNR say something.
SETTINGS = (
    "--preset", "laptop", "--iterations", "40", "--anchors.offsets", "2", "--anchors.voxel", "0.8",
    "--rates.features", "0.03", "0.03", "--growth.start", "10", "--growth.statistics-from", "0",
    "--growth.gate", "0.05", "--growth.interval", "10", "--growth.max-anchors", "200",
)  # fmt: skip
CUT = ("--blocks", "2", "--assignment.min-cameras", "3")
BLOCK = (
    "--block.iterations", "16", "--block.growth.start", "8", "--block.growth.statistics-from", "0",
    "--block.growth.interval", "8", "--block.growth.gate", "0.05",
)  # fmt: skip


def vdgs(*arguments: object) -> None:
    """A verb in this process; its exit code must be 0."""
    with pytest.raises(SystemExit) as ended:
        cli.main([str(each) for each in arguments])
    assert not ended.value.code


def after_the_coarse_stage(run: Path) -> None:
    vdgs("visibility", run)
    vdgs("partition", run, *CUT)
    for block in (0, 1):
        vdgs("train", run, "--block", block, *BLOCK)
    vdgs("merge", run)
    vdgs("eval", run, "--model", "coarse")
    vdgs("eval", run, "--model", "merged")


def psnr(run: Path) -> tuple[float, float]:
    """Of the coarse and of the merged model."""
    folders = (run / "coarse" / "evaluation", run / "evaluation")
    coarse, merged = (json.loads((folder / "metrics.json").read_text())["psnr"] for folder in folders)
    return coarse, merged


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> tuple[Path, Path, Path]:
    """A run by each set of operations, and one by the reference from the native run's coarse model on."""
    folder = tmp_path_factory.mktemp("sets")
    write_colmap(folder / "capture", tiny_scene(columns=3, rows=2, width=32, height=24, points=80))
    native, twin, shared = folder / "native", folder / "twin", folder / "shared"
    with pytest.MonkeyPatch.context() as patch:
        vdgs("coarse", folder / "capture", "--output", native, "--up", "z", *SETTINGS)
        shutil.copytree(native, shared)
        after_the_coarse_stage(native)
        patch.setenv(kernels.VARIABLE, "reference")
        assert kernels.choose(torch.device("cpu")) is reference
        vdgs("coarse", folder / "capture", "--output", twin, "--up", "z", *SETTINGS)
        after_the_coarse_stage(twin)
        after_the_coarse_stage(shared)
    return native, twin, shared


def test_both_sets_learn_the_place_alike(runs):
    native, twin, _ = runs
    for ours, theirs in zip(psnr(native), psnr(twin), strict=True):
        assert ours > 13  # 12.0 for a plain grey picture
        assert theirs == pytest.approx(ours, abs=0.6)
    before, after = (len(AnchorModel.load(twin / name / "model.safetensors").anchors) for name in ("coarse", "merged"))
    assert after != before  # blocks have trained and grown
    first = json.loads((twin / "coarse" / "log.jsonl").read_text().splitlines()[0])
    same = json.loads((native / "coarse" / "log.jsonl").read_text().splitlines()[0])
    assert first["loss"] == pytest.approx(same["loss"], rel=0.05)


def test_from_one_coarse_model_both_cut_assign_and_measure_alike(runs):
    native, _, shared = runs
    opened = [open_run(run, "coarse") for run in (native, shared)]
    seen = [visibility_of_run(run, [view.camera for view in run.capture.train_views]) for run in opened]
    assert torch.equal(*seen)
    assert (native / "partition" / "blocks.geojson").read_bytes() == (
        shared / "partition" / "blocks.geojson"
    ).read_bytes()
    ours, theirs = (load_scores(RunFolder(run).partition / "scores.npz") for run in (native, shared))
    np.testing.assert_allclose(theirs.scores.scores, ours.scores.scores, atol=0.02)
    np.testing.assert_array_equal(theirs.scores.held, ours.scores.held)
    assert psnr(shared)[0] == pytest.approx(psnr(native)[0], abs=0.01)
    assert psnr(shared)[1] == pytest.approx(psnr(native)[1], abs=0.6)
