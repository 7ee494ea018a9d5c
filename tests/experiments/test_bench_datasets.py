"""The published data sets' scenes of `vdgs bench`, end to end: a tiny place written in their layouts."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from experiments.bench.measure import final_evaluation_folder
from experiments.bench.scenes import SCENES
from support.captures import tiny_scene, write_colmap
from support.commands import do_tasks_here, vdgs
from support.dataset_layouts import halves, write_matrixcity, write_mega_nerf
from vdgs.runs.run_folder import RunFolder

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("bench_datasets")]

WIDTH, HEIGHT = 96, 72


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A place as `residence-pixsfm` with a COLMAP model beside it, and as MatrixCity's small city."""
    folder = tmp_path_factory.mktemp("data")
    scene = tiny_scene(columns=6, rows=3, width=WIDTH, height=HEIGHT, points=400)
    residence = folder / "residence-pixsfm"
    names = {Path(name).name: camera for name, camera in write_mega_nerf(residence, scene).cameras.items()}
    write_colmap(residence, replace(scene, cameras=names), images=None)
    write_matrixcity(folder / "small_city" / "aerial" / "pose" / "block_all", *halves(scene, 15))
    return folder


def test_the_published_data_sets_are_benched(data, tmp_path):
    """Their folders are found and read, methods run with the paper's settings, and pixels are grouped by V."""
    asked = ("--scenes", "residence", "block-all", "--methods", "baseline", "--total-iterations", "40")
    done = vdgs("bench", "table1", "--output", tmp_path, "--data", data, *asked, "--seeds", "1", prepare=do_tasks_here)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "table1" / "results.json").read_text())["results"]
    assert [(each["scene"], each["state"]) for each in results] == [("residence", "done"), ("block-all", "done")]
    for each in results:
        assert 5 < each["figures"]["psnr"] < 40
        assert each["figures"]["psnr@0"] is not None
        assert each["visibility_source"] == "model"  # nobody knows the truth about a photograph
        run, scene = RunFolder(tmp_path / each["folder"]), SCENES[each["scene"]]
        used, paper = run.method(), scene.base(scene.budget, 0)
        assert used.training.densify.grad_threshold == paper.training.densify.grad_threshold
        assert used.block.densify.grad_threshold == paper.block.densify.grad_threshold
        renders = sorted((final_evaluation_folder(run.path) / "renders").iterdir())
        assert len(renders) == {"residence": 4, "block-all": 3}[each["scene"]]  # the split that the layout brings
        scale = scene.options["downscale"]
        assert cv2.imread(str(renders[0])).shape == (int(HEIGHT / scale), int(WIDTH / scale), 3)
