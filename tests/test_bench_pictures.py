"""Pictures by other programs as rows of the bench."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from bench_support import benched, run_here, write_data
from vdgs.bench import bench
from vdgs.bench.measure import evaluated
from vdgs.bench.plan import Choices, make_plan
from vdgs.errors import VdgsError


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_data(folder)
    return folder


@pytest.fixture(scope="module")
def output(data, tmp_path_factory) -> Path:
    """A bench of one method of our own."""
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(bench, "run_tasks", run_here)
        benched(data, folder, "baseline")
    return folder


@pytest.fixture(autouse=True)
def here(monkeypatch) -> None:
    monkeypatch.setattr(bench, "run_tasks", run_here)


@pytest.fixture
def theirs(output, tmp_path) -> Path:
    """Its pictures, as another program would leave them."""
    folder = tmp_path / "theirs"
    shutil.copytree(evaluated(output / "runs" / "copr" / "baseline" / "0") / "renders", folder / "copr")
    return folder


def test_pictures_of_our_own_measure_as_our_own(data, output, theirs):
    both = benched(data, output, "baseline", renders=(f"Some Program 2={theirs}",))
    ours, foreign = both["baseline"], both["some-program-2"]
    quality = {name: value for name, value in ours.figures.items() if name.startswith(("psnr", "ssim", "lpips"))}
    assert quality["psnr"]
    assert quality["psnr@0"]
    assert {name: foreign.figures[name] for name in quality} == quality
    assert (foreign.groups, foreign.seen_by) == (ours.groups, ours.seen_by)
    for cost in ("anchors", "gaussians", "iterations", "seconds", "peak_memory_bytes", "fps"):
        assert foreign.figures.get(cost) is None, cost
    text = (output / "table1" / "table.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| Some Program 2 | –"))
    assert set(row.removeprefix("| Some Program 2 |").split()) == {"–", "|"}  # what it cost
    assert "pictures that another program rendered" in text


def test_other_pictures_are_measured_again(data, output, theirs):
    def psnr() -> float:
        figure = benched(data, output, "baseline", renders=(f"other={theirs}",))["other"].figures["psnr"]
        assert figure is not None
        return figure

    before = psnr()
    metrics = output / "runs" / "copr" / "other" / "0" / "evaluation" / "metrics.json"
    written = metrics.stat().st_mtime_ns
    assert psnr() == before
    assert metrics.stat().st_mtime_ns == written  # not measured twice
    for file in (theirs / "copr").glob("*.png"):
        cv2.imwrite(str(file), 255 - cv2.imread(str(file)))
    assert psnr() < before
    # The folder of a seed goes before that of the scene.
    shutil.copytree(evaluated(output / "runs" / "copr" / "baseline" / "0") / "renders", theirs / "copr" / "0")
    assert psnr() == before


def test_pictures_that_cannot_be_measured_are_named_before_anything_is_trained(data, theirs, tmp_path):
    def complaint() -> str:
        with pytest.raises(VdgsError) as raised:
            benched(data, tmp_path / "out", "baseline", renders=(f"other={theirs}",))
        assert not (tmp_path / "out" / "runs").exists()
        return str(raised.value)

    first = sorted((theirs / "copr").glob("*.png"))[0]
    height, width = cv2.imread(str(first)).shape[:2]
    cv2.imwrite(str(first), np.zeros((height + 1, width, 3), np.uint8))
    assert f"{first}: is {width} x {height + 1} pixels" in complaint()
    assert f"{width} x {height}. Render it in that size" in complaint()
    first.write_bytes(b"no picture")
    assert f"{first}: cannot be read as a picture" in complaint()
    first.unlink()
    assert f"{first}: is not there. The test view" in complaint()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("renders", "give a name and a folder"),
        ("=renders", "give a name and a folder"),
        ("name=nowhere", "'nowhere' is not a folder"),
        ("3DGS={folder}", "there is a method '3dgs' already"),
        ("mine={folder}", r"holds no pictures. They are looked for in folders named after the scenes \(copr\)"),
    ],
)
def test_what_cannot_be_a_row_is_refused(text, why, tmp_path):
    with pytest.raises(VdgsError, match=why):
        make_plan("table1", Choices(scenes=("copr",), renders=(text.format(folder=tmp_path),)))


def test_scenes_and_seeds_without_pictures_are_left_out(tmp_path):
    for folder in ("copr", "copr/2", "brighton/1"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "view.png").write_bytes(b"")
    choices = Choices(
        seeds=3, scenes=("copr", "brighton", "seneca"), methods=("baseline",), renders=(f"mine={tmp_path}",)
    )
    plan = make_plan("table1", choices)
    mine = {(scene, seed): run.pictures for (scene, method, seed), run in plan.answers.items() if method == "mine"}
    assert mine == {
        ("copr", 0): tmp_path / "copr", ("copr", 2): tmp_path / "copr/2", ("brighton", 1): tmp_path / "brighton/1"
    }  # fmt: skip
