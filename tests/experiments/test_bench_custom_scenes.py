"""Captures of one's own as scenes of the bench, by their folders."""

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.bench import bench
from experiments.bench.bench import BenchSettings, run_bench
from experiments.bench.custom_scenes import budget_for, resolve_scenes
from experiments.bench.definitions import Budget
from experiments.bench.plan import PlanOptions, make_plan
from experiments.bench.results import BenchResult
from experiments.bench.scenes import LAPTOP_BUDGET, SCENES
from support.bench import InThisProcess
from support.captures import tiny_scene, write_colmap
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import resolve_iterations
from vdgs.config.presets import PRESETS
from vdgs.errors import CaptureError, VdgsError

pytestmark = [pytest.mark.xdist_group("bench_custom_scenes"), pytest.mark.slow]

PLAIN = CaptureOptions()


def names(*texts: object, options: CaptureOptions = PLAIN) -> list[str]:
    return [scene.name for scene in resolve_scenes([str(text) for text in texts], options, False)]


@pytest.fixture(scope="module")
def captures(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("captures")
    write_colmap(folder / "My place (2024)", tiny_scene())
    for name in ("2023/site", "2024/site", "copr"):
        shutil.copytree(folder / "My place (2024)", folder / name)
    return folder


def test_a_name_is_a_name_and_a_folder_a_folder(captures, monkeypatch):
    monkeypatch.chdir(captures)
    assert resolve_scenes(["copr", "tiny"], PLAIN, False) == (SCENES["copr"], SCENES["tiny"])
    (folder,) = resolve_scenes(["./copr"], PLAIN, False)
    assert (folder.name, folder.folder, folder.capture) == ("copr-2", captures / "copr", None)
    assert names("2023/site", "tiny", "copr") == ["site", "tiny", "copr"]
    assert names("My place (2024)") == ["My-place-2024"]
    monkeypatch.chdir(captures / "2023" / "site")
    assert names(".") == ["site"]


def test_every_scene_has_a_name_of_its_own(captures):
    assert names(captures / "2024" / "site", captures / "2023" / "site") == ["site", "site-2"]
    with pytest.raises(VdgsError, match="is there twice"):
        names(captures / "2024" / "site", captures / "2023" / ".." / "2024" / "site")
    with pytest.raises(VdgsError, match="copr is there twice"):
        names("copr", "copr")


@given(st.integers(1, 5_000))
def test_iterations_go_by_the_photographs_as_in_the_preset(training):
    budget, laptop = budget_for(training), PRESETS["laptop"].training
    assert budget.coarse == resolve_iterations(laptop, training).iterations
    assert budget.blocks * budget.per_block == pytest.approx(budget.coarse, abs=budget.blocks)
    assert budget.blocks == LAPTOP_BUDGET.blocks


def test_small_captures_have_the_budget_of_the_small_ones_with_names():
    assert budget_for(12) == budget_for(50) == LAPTOP_BUDGET == SCENES["copr"].budget
    assert budget_for(100) == Budget(6_000, 4, 1_500)
    assert budget_for(10_000) == Budget(30_000, 4, 7_500)


def test_the_plan_reads_them_as_asked(captures):
    options = CaptureOptions(downscale=2.0, test_every=3, georef=Path("georef.json"))
    choices = PlanOptions(scenes=(str(captures / "copr"), "tiny"), seeds=1, options=replace(options, georef=None))
    plan = make_plan("table2", choices)
    scene = plan.scenes[0]
    assert plan.scenes[1] == SCENES["tiny"]
    assert dict(scene.options) == {"downscale": 2.0, "test_every": 3}
    assert "8 training and 4 test photographs of 32 x 24" in scene.note
    full = plan.run_of["copr-2", "full", 0].config
    assert (full.training.iterations, full.partition.blocks, full.assignment.min_cameras) == (3_000, 4, 16)
    with pytest.raises(VdgsError, match=r"--downscale, --test-every, --georef: say how a capture is read"):
        make_plan("table2", PlanOptions(scenes=("tiny",), options=options))


@pytest.mark.parametrize(
    ("text", "options", "error", "said"),
    [
        ("no-such-place", PLAIN, VdgsError, "there is no scene 'no-such-place'.*tiny.*such as ./my-place"),
        ("./no-such-place", PLAIN, CaptureError, "no-such-place: no such folder"),
        ("2023", PLAIN, CaptureError, "2023: not a capture itself. 2023/site is a capture"),
        ("./copr", CaptureOptions(images="images_8"), CaptureError, "images_8: no such folder.*capture: images, spar"),
        ("./copr", CaptureOptions(downscale=0.5), CaptureError, r"--downscale 0.5: must be at least 1"),
    ],
)
def test_what_is_no_capture_is_refused_before_any_work(captures, tmp_path, monkeypatch, text, options, error, said):
    monkeypatch.chdir(captures)
    asked = BenchSettings("table2", tmp_path / "out", PlanOptions(scenes=("tiny", text), options=options))
    with pytest.raises(error, match=said):
        run_bench(asked, Console(file=io.StringIO()))
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_held_out_is_refused_too(tmp_path):
    write_colmap(tmp_path / "two", tiny_scene(columns=2, rows=1))
    make_plan("table2", PlanOptions(scenes=(str(tmp_path / "two"),)))
    with pytest.raises(CaptureError):
        make_plan("table2", PlanOptions(scenes=(str(tmp_path / "two"),), validation=True))


def benched(folder: Path, output: Path) -> list[BenchResult]:
    choices = PlanOptions(
        scenes=(str(folder),), seeds=1, methods=("baseline",), total_iterations=24, options=CaptureOptions(downscale=2)
    )
    return run_bench(BenchSettings("table2", output, choices), Console(file=io.StringIO()))


def test_a_folder_becomes_a_table_and_keeps_its_results_where_it_goes(captures, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "LocalExecutor", InThisProcess)
    output = tmp_path / "out"
    (result,) = benched(captures / "My place (2024)", output)
    assert (result.scene, result.state, result.figures["iterations"]) == ("My-place-2024", "done", 24)
    table = (output / "table2" / "table.md").read_text()
    assert "My-place-2024: what each method got" in table
    assert "A capture given as a folder: 10 training and 2 test photographs of 32 x 24" in table
    assert str(captures) not in table
    said = json.loads((output / "table2" / "results.json").read_text())
    assert said["plan_options"]["options"]["downscale"] == 2
    trained = (output / result.folder / "coarse" / "model.safetensors").stat().st_mtime_ns
    moved = Path(shutil.copytree(captures / "My place (2024)", tmp_path / "elsewhere" / "My place (2024)"))
    (again,) = benched(moved, output)
    assert again == result
    assert (output / result.folder / "coarse" / "model.safetensors").stat().st_mtime_ns == trained
    # Another capture of that name is not taken for it.
    shutil.rmtree(moved)
    write_colmap(moved, tiny_scene(seed=1))
    with pytest.raises(VdgsError, match=r"is not the capture that .* was made from any more"):
        benched(moved, output)
