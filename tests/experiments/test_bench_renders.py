"""Renders by other programs as rows of the bench."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from experiments.bench import bench
from experiments.bench.claim_check import check_claims
from experiments.bench.measure import final_evaluation_folder
from experiments.bench.notes import make_notes
from experiments.bench.plan import PlanOptions, make_plan
from experiments.bench.results import COVERAGE_KEYS, REFERENCE_EXPOSURE_KEYS
from support.bench import InThisProcess, benched, write_data
from vdgs.errors import VdgsError
from vdgs.evaluation import comparison_images

pytestmark = [pytest.mark.xdist_group("bench_renders"), pytest.mark.slow]


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
        patched.setattr(bench, "LocalExecutor", InThisProcess)
        benched(data, folder, "baseline")
    return folder


@pytest.fixture(autouse=True)
def here(monkeypatch) -> None:
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)


@pytest.fixture
def theirs(output, tmp_path) -> Path:
    """Its renders, as another program would leave them."""
    folder = tmp_path / "theirs"
    shutil.copytree(final_evaluation_folder(output / "runs" / "copr" / "baseline" / "0") / "renders", folder / "copr")
    return folder


def test_renders_of_our_own_measure_as_our_own(data, output, theirs):
    both = benched(data, output, "baseline", renders=(f"Some Program 2={theirs}",))
    ours, foreign = both["baseline"], both["some-program-2"]
    quality = {
        name: value for name, value in ours.figures.items()
        if name.startswith(("psnr", "ssim", "lpips")) and name not in (*COVERAGE_KEYS, *REFERENCE_EXPOSURE_KEYS)
    }  # fmt: skip
    assert quality["psnr"]
    assert quality["psnr@0"]
    assert {name: foreign.figures[name] for name in quality} == quality
    assert (foreign.groups, foreign.visibility_source) == (ours.groups, ours.visibility_source)
    for of_alpha in COVERAGE_KEYS:  # an opaque picture does not say
        assert foreign.figures[of_alpha] is None, of_alpha
    for of_colors in REFERENCE_EXPOSURE_KEYS:  # nor what it would be in another exposure
        assert ours.figures[of_colors] is not None, of_colors
        assert foreign.figures[of_colors] is None, of_colors
    assert ours.figures["opacity_coverage"] is not None
    for cost in ("anchors", "gaussians", "iterations", "seconds", "peak_memory_bytes", "fps"):
        assert foreign.figures.get(cost) is None, cost
    text = (output / "table1" / "table.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| Some Program 2 | –"))
    assert set(row.removeprefix("| Some Program 2 |").split()) == {"–", "|"}  # what it cost
    assert "rendered by another program" in text
    assert "None of this is known of Some Program 2" in text


def test_other_renders_are_measured_again(data, output, theirs):
    def psnr() -> float:
        figure = benched(data, output, "baseline", renders=(f"other={theirs}",))["other"].figures["psnr"]
        assert figure is not None
        return figure

    before = psnr()
    metrics = output / "runs" / "copr" / "renders-other" / "0" / "evaluation" / "metrics.json"
    written = metrics.stat().st_mtime_ns
    assert psnr() == before
    assert metrics.stat().st_mtime_ns == written  # not measured twice
    for file in (theirs / "copr").glob("*.png"):
        cv2.imwrite(str(file), 255 - cv2.imread(str(file)))
    assert psnr() < before
    # The folder of a seed goes before that of the scene, but for an empty one.
    (theirs / "copr" / "0").mkdir()
    assert psnr() < before
    (theirs / "copr" / "0").rmdir()
    shutil.copytree(
        final_evaluation_folder(output / "runs" / "copr" / "baseline" / "0") / "renders", theirs / "copr" / "0"
    )
    assert psnr() == before


def test_what_was_broken_off_is_measured_again(data, output, theirs, monkeypatch):
    asked = {"renders": (f"broken={theirs}",)}
    before = benched(data, output, "baseline", **asked)["broken"].figures["psnr"]
    files = sorted((theirs / "copr").glob("*.png"))
    pictures = [file.read_bytes() for file in files]
    for file in files:
        cv2.imwrite(str(file), 255 - cv2.imread(str(file)))
    write, written = comparison_images.write_png, []

    def interrupted(path, picture):
        if path.parent.name == "renders" and written:
            raise KeyboardInterrupt
        written.append(path)
        write(path, picture)

    with monkeypatch.context() as patched:
        patched.setattr(comparison_images, "write_png", interrupted)
        with pytest.raises(KeyboardInterrupt):
            benched(data, output, "baseline", **asked)
    for file, picture in zip(files, pictures, strict=True):
        file.write_bytes(picture)
    assert benched(data, output, "baseline", **asked)["broken"].figures["psnr"] == before
    for file, picture in zip(files, pictures, strict=True):
        measured = output / "runs" / "copr" / "renders-broken" / "0" / "evaluation" / "renders" / file.name
        assert (cv2.imread(str(measured)) == cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)).all()


def test_renders_that_cannot_be_measured_are_named_before_anything_is_trained(data, theirs, tmp_path):
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
    count = len(list((theirs / "copr").glob("*.png")))
    assert f"{theirs / 'copr'}: lacks 1 of {count + 1} views: {first.name} (" in complaint()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("renders", r"give a name \(.*\) and a folder"),
        ("=renders", r"give a name \(.*\) and a folder"),
        ("name=", r"give a name \(.*\) and a folder"),
        ("$\\foo$={folder}", r"give a name \(.*\) and a folder"),
        ("_hidden={folder}", r"give a name \(.*\) and a folder"),
        ("name=nowhere", "'nowhere' is not a folder"),
        ("w/o blocking={folder}", r"give a name \(.*\) and a folder"),
        ("3DGS={folder}", "there is a method '3DGS' already"),
        ("mine={folder}", r"holds no renders. They are looked for in folders named after the scenes \(copr\)"),
    ],
)
def test_what_cannot_be_a_row_is_refused(text, why, tmp_path):
    with pytest.raises(VdgsError, match=why):
        make_plan("table1", PlanOptions(scenes=("copr",), renders=(text.format(folder=tmp_path),)))


def test_scenes_and_seeds_without_renders_are_left_out_and_named(tmp_path):
    for folder in ("copr", "copr/2", "brighton/1"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "view.png").write_bytes(b"")
    choices = PlanOptions(
        seeds=3, scenes=("copr", "brighton", "seneca"), methods=("baseline",), renders=(f"mine={tmp_path}",)
    )
    plan = make_plan("table1", choices)
    mine = {(scene, seed): run.renders for (scene, method, seed), run in plan.run_of.items() if method == "mine"}
    assert mine == {
        ("copr", 0): tmp_path / "copr", ("copr", 2): tmp_path / "copr/2", ("brighton", 1): tmp_path / "brighton/1"
    }  # fmt: skip
    missing = next(note for note in make_notes(plan, [], [], False) if note.startswith("## Missing"))
    assert [line.split(": ", 1)[1] for line in missing.splitlines()[2:]] == [
        "no renders for seed 1.", "no renders for seed 0, 2.", "no renders for seed 0, 1, 2."
    ]  # fmt: skip
    assert not [line for line in check_claims(plan, []) if line.scene.startswith("seneca") and "mine" in line.question]
