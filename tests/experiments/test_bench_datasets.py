"""The published data sets' scenes of `vdgs bench`, end to end: a tiny generated town written in their layouts."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from experiments.bench.scenes import SCENES
from support.captures import TinyScene, write_colmap
from support.commands import do_tasks_here, vdgs
from support.dataset_layouts import halves, write_matrixcity, write_mega_nerf
from vdgs.captures.capture import Capture
from vdgs.captures.loading import load_capture
from vdgs.runs.run_folder import RunFolder
from vdgs.synth import SynthOptions, generate

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("bench_datasets")]

WIDTH, HEIGHT = 160, 120


def photographs(files: list[Path], capture: Capture) -> None:
    """Let files hold the photographs of the town, in the order of its views."""
    for file, view in zip(files, capture.views, strict=True):
        assert file.is_file()
        assert cv2.imwrite(str(file), cv2.imread(str(view.image_path)))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A town as `residence-pixsfm` with a COLMAP model beside it, and as MatrixCity's small city."""
    pytest.importorskip("embreex")
    folder = tmp_path_factory.mktemp("data")
    options = SynthOptions(
        size="toy", num_images=15, num_test_images=3, num_validation_images=0, width=WIDTH, height=HEIGHT,
        samples_per_pixel=1, num_points=800, extent_m=60.0,
    )  # fmt: skip
    generate(folder / "town", options)
    town = load_capture(folder / "town")
    scene = TinyScene({view.name: view.camera for view in town.views}, town.points, town.point_colors)

    residence = folder / "residence-pixsfm"
    renamed = write_mega_nerf(residence, scene)
    photographs([residence / Path(n).parent / "rgbs" / Path(n).name for n in renamed.cameras], town)
    names = {Path(name).name: camera for name, camera in renamed.cameras.items()}
    write_colmap(residence, replace(scene, cameras=names), images=None)

    aerial = folder / "small_city" / "aerial"
    both = write_matrixcity(aerial / "pose" / "block_all", *halves(scene, len(town.train_views)))
    photographs([aerial / name for name in both.cameras], town)
    return folder


def test_the_published_data_sets_are_benched(data, tmp_path):
    """Their folders are found and read, methods run with the paper's settings, and pixels are grouped by V."""
    asked = ("--scenes", "residence", "block-all", "--methods", "blocks-2", "--total-iterations", "40")
    done = vdgs("bench", "table1", "--output", tmp_path, "--data", data, *asked, "--seeds", "1", prepare=do_tasks_here)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "table1" / "results.json").read_text())["results"]
    assert [(each["scene"], each["state"]) for each in results] == [("residence", "done"), ("block-all", "done")]
    for each in results:
        assert 5 < each["figures"]["psnr"] < 40
        assert each["figures"]["psnr@0"] is not None
        assert each["visibility_source"] == "model"  # nobody knows the truth about a photograph
        run, scene = RunFolder(tmp_path / each["folder"]), SCENES[each["scene"]]
        assert run.method().block.densify.grad_threshold == scene.base(scene.budget, 0).block.densify.grad_threshold
        renders = sorted((run.evaluation / "renders").iterdir())
        assert len(renders) == {"residence": 4, "block-all": 3}[each["scene"]]  # the split that the layout brings
        scale = scene.options["downscale"]
        assert cv2.imread(str(renders[0])).shape == (int(HEIGHT / scale), int(WIDTH / scale), 3)
