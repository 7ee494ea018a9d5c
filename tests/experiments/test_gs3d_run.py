"""3DGS as a comparator, as people use it: trained, stopped, continued, measured, refused."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rich.console import Console

from experiments.baselines.gs3d import run as comparator
from experiments.baselines.gs3d import session as gaussian_session
from experiments.baselines.gs3d.density import DensityConfig
from experiments.baselines.gs3d.model import (
    GaussianModel,
)
from experiments.baselines.gs3d.training import (
    Gs3dConfig,
    train,
)
from support.captures import tiny_scene, write_colmap
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.executor_options import CheckpointOptions
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.evaluation.renderable_model import EvaluationSettings
from vdgs.geometry.camera import Camera
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder

pytestmark = [pytest.mark.xdist_group("gaussians"), pytest.mark.slow]

DENSITY = DensityConfig(start=15, interval=10, until=0.5, dense=0.08, reset_interval=40)
SHORT = Gs3dConfig(iterations=60, resolution_schedule=((0, 2), (30, 1)), density=DENSITY)
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene())
    return load_capture(folder, CaptureOptions(up="z"))


@pytest.fixture(scope="module")
def trained(capture, tmp_path_factory):
    run_ = RunFolder(tmp_path_factory.mktemp("run"))
    result = comparator.run_gs3d(
        run_, capture, SHORT, QUIET, visibility_map=lambda camera: np.full((camera.height, camera.width), 3.0)
    )
    return SimpleNamespace(run=run_, result=result, folder=StageFolder(run_.path / "gaussians"))


def test_a_run_leaves_model_log_and_figures(trained):
    written = json.loads((trained.run.evaluation / "metrics.json").read_text())
    assert written == trained.result
    assert written["model"] == "3dgs"
    assert written["psnr"] > 12
    assert written["by_visibility"][0]["lower"] == written["by_visibility"][-1]["upper"] == 3.0
    model = GaussianModel.load(trained.folder.model)
    assert written["n_gaussians"] == len(model.gaussians)
    lines = [json.loads(line) for line in trained.folder.log.read_text().splitlines()]
    assert [line["iteration"] for line in lines] == [20, 50]  # a decision (30 ends them), and a PSNR
    assert lines[-1]["loss"] < 0.7 * lines[0]["loss"]
    assert (trained.run.evaluation / "contact_sheet.png").exists()
    assert written["train_seconds"] > 0


def test_a_finished_run_is_only_read(trained, capture):
    before = trained.folder.model.stat().st_mtime_ns
    comparator.train_gs3d(capture, SHORT, trained.folder.path, QUIET)
    assert trained.folder.model.stat().st_mtime_ns == before


def test_a_stopped_run_continues_from_its_last_state(trained, capture, tmp_path, monkeypatch):
    def stopped(state, stage_, *, stop, after_step):
        return train(state, stage_, stop=lambda: state.iteration >= 37, after_step=after_step)

    monkeypatch.setattr(gaussian_session, "train", stopped)
    with pytest.raises(Stopped, match="37"):
        comparator.train_gs3d(capture, SHORT, tmp_path, QUIET, options=CheckpointOptions(save_every=10))
    assert StageFolder(tmp_path).status().state == "stopped"
    monkeypatch.undo()
    comparator.train_gs3d(capture, SHORT, tmp_path, QUIET)
    assert StageFolder(tmp_path).model.read_bytes() == trained.folder.model.read_bytes()


def test_other_settings_and_other_captures_are_refused(trained, capture, tmp_path):
    with pytest.raises(RunError, match="iterations: 60 -> 61"):
        comparator.train_gs3d(capture, replace(SHORT, iterations=61), trained.folder.path, QUIET)
    write_colmap(tmp_path, tiny_scene(seed=1))
    other = load_capture(tmp_path, CaptureOptions(up="z"))
    with pytest.raises(RunError, match="is not the capture"):
        comparator.train_gs3d(other, SHORT, trained.folder.path, QUIET)
    with pytest.raises(RunError, match="is not the capture"):
        comparator.evaluate_gs3d(GaussianModel.load(trained.folder.model), other, tmp_path / "evaluation")


def test_the_background_is_black_or_that_of_the_photographs(trained, capture, tmp_path):
    assert GaussianModel.load(trained.folder.model).background == (0.0, 0.0, 0.0)
    mean = replace(SHORT, iterations=1, background="mean")
    model = comparator.train_gs3d(capture, mean, tmp_path, QUIET)
    assert all(0.3 < value < 0.7 for value in model.background)
    away = Camera(
        camera_from_world=np.diag([1.0, 1, 1, 1]), fx=20.0, fy=20.0, cx=4.0, cy=4.0, width=8, height=8
    )  # looks up from the ground
    moved = replace(model.gaussians, means=model.gaussians.means - torch.tensor([0.0, 0.0, 100.0]))
    nothing = replace(model, gaussians=moved).render(away).image
    torch.testing.assert_close(nothing, torch.tensor(model.background).expand(8, 8, 3))


def test_settings_that_do_not_work_are_named(capture, tmp_path):
    wrong = replace(SHORT, iterations=0, resolution_schedule=((5, 1),), degree=4)
    with pytest.raises(VdgsError, match=r"(?s)iterations.*degree.*resolution_schedule"):
        comparator.train_gs3d(capture, wrong, tmp_path / "run", QUIET)
    assert not (tmp_path / "run").exists()


def test_a_model_is_measured_without_its_folder(trained, capture, tmp_path):
    model = GaussianModel.load(trained.folder.model)
    result = comparator.evaluate_gs3d(
        model, capture, tmp_path, settings=EvaluationSettings(comparisons=False, color_correction=False)
    )
    assert result["psnr"] == pytest.approx(trained.result["psnr"])
    assert result["by_visibility"] is None


@pytest.mark.parametrize("damage", ["truncate", "text", "nan", "missing", "bits"])
def test_a_damaged_model_is_refused(trained, tmp_path, damage):
    path, model = tmp_path / "model.safetensors", GaussianModel.load(trained.folder.model)
    if damage == "nan":
        model = replace(model, gaussians=replace(model.gaussians, means=model.gaussians.means * float("nan")))
    model.save(path)
    if damage == "truncate":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage == "text":
        path.write_text("not a model")
    elif damage == "missing":
        path.unlink()
    elif damage == "bits":
        path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(VdgsError, match=r"model\.safetensors"):
        GaussianModel.load(path)
