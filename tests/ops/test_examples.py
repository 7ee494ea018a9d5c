"""The examples run as they are, on something small."""

from __future__ import annotations

import importlib.util
import json
import runpy
import sys
from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from support.captures import tiny_scene, write_colmap
from vdgs.synth import SynthOptions

pytestmark = [pytest.mark.xdist_group("api"), pytest.mark.slow]
EXAMPLES = Path(__file__).parents[2] / "examples"
NAMES = sorted(file.name for file in EXAMPLES.iterdir() if file.suffix in (".py", ".ipynb"))


@pytest.fixture
def run(native_small):
    return native_small.whole


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A capture of six small photographs."""
    folder = tmp_path_factory.mktemp("place") / "capture"
    write_colmap(folder, tiny_scene(columns=3, rows=2, width=32, height=24, points=80))
    return folder


@pytest.fixture
def example(monkeypatch, capsys):
    """Runs an example as `python FILE ARGUMENTS` does; returns what it prints."""

    def start(number: int, *arguments: object) -> str:
        (file,) = EXAMPLES.glob(f"{number:02d}_*.py")
        monkeypatch.setattr(sys, "argv", [str(file), *map(str, arguments)])
        runpy.run_path(str(file), run_name="__main__")
        return capsys.readouterr().out

    return start


def test_there_are_eight_of_less_than_sixty_lines():
    assert [int(name[:2]) for name in NAMES] == list(range(1, 9))
    for name in NAMES[:-1]:
        text = (EXAMPLES / name).read_text(encoding="utf-8")
        assert len(text.splitlines()) < 60, name
        assert f"python examples/{name} " in text, name
    assert sum(source.count("\n") + 1 for source in cells()) < 60


def test_a_run_is_opened_and_drawn(example, run, tmp_path):
    assert "anchors" in example(1, run, tmp_path)
    with Image.open(tmp_path / "view.png") as view, Image.open(tmp_path / "depth.png") as depth:
        assert view.size == depth.size == (32, 24)


def test_visibility_is_plotted(example, run, tmp_path):
    assert "5 cameras; V is" in example(2, run, tmp_path)
    assert (tmp_path / "visibility.png").stat().st_size > 1000


def test_blocks_and_their_cameras_are_listed(example, run):
    said = example(3, run, 2)
    assert "block 0: " in said
    assert "block 1: " in said


def test_a_capture_is_trained(example, place, tmp_path):
    import vdgs

    said = example(4, place, tmp_path, 20)
    assert {"coarse:", "block"} <= set(said.split())
    assert len(vdgs.Scene.load(tmp_path / "scene.safetensors")) > 0


def test_an_image_is_fitted(example, tmp_path):
    said = example(5, tmp_path, 6).splitlines()
    first, last = (float(line.split(": ")[1].split(" dB")[0]) for line in (said[0], said[-1]))
    assert last > first
    assert (tmp_path / "fitted.png").is_file()
    Image.new("RGB", (20, 30), (10, 200, 30)).save(tmp_path / "green.png")
    example(5, tmp_path, 1, tmp_path / "green.png")


def test_gaussians_grow_in_a_loop_of_ones_own(example, place):
    said = example(6, place, 150)
    assert "Step 150: " in said
    assert "80 points became" in said
    assert "80 points became 80 " not in said


def test_files_are_written_without_a_screen(example, run, tmp_path, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    example(7, run, tmp_path)
    names = {"scene.ply", "scene.spz", "scene.points.ply", "supersplat.compressed.ply"}
    assert names <= {file.name for file in tmp_path.iterdir()}


def cells() -> list[str]:
    notebook = json.loads((EXAMPLES / NAMES[-1]).read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


@pytest.mark.skipif(importlib.util.find_spec("embreex") is None, reason="embreex: pip install 'vdgs[synth]'")
def test_the_notebook_runs_from_top_to_bottom(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    # Pictures are drawn, and no one looks at them.
    small = partial(SynthOptions, width=48, height=36, samples_per_pixel=1, num_test_images=1, extent_m=50.0)
    monkeypatch.setattr("vdgs.synth.SynthOptions", small)
    if importlib.util.find_spec("nbclient") and importlib.util.find_spec("ipykernel"):
        import nbclient
        import nbformat

        nbclient.NotebookClient(nbformat.read(EXAMPLES / NAMES[-1], as_version=4)).execute()
        return
    import matplotlib.pyplot as plt

    namespace: dict[str, object] = {"__name__": "__main__"}
    for source in cells():
        exec(compile(source, NAMES[-1], "exec"), namespace)
    assert len(plt.get_fignums()) == 2
    plt.close("all")
    said = capsys.readouterr().out
    assert "training cameras" in said
    assert "by place and visibility: mean V of the blocks" in said
