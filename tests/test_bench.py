"""The evidence harness: definitions hold together, statistics and marks are right, a real bench runs and continues."""

import csv
import fcntl
import io
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import typing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from vdgs.bench import bench
from vdgs.bench.bench import BenchSettings, run_bench
from vdgs.bench.definitions import Budget, Method, Scene
from vdgs.bench.figure import draw_groups
from vdgs.bench.grids import Cell, Grid, Row, grids_of
from vdgs.bench.measure import group_names
from vdgs.bench.methods import METHODS
from vdgs.bench.notes import notes_of
from vdgs.bench.plan import Choices, make_plan
from vdgs.bench.processes import Task, run_tasks
from vdgs.bench.quoted import QUOTED
from vdgs.bench.results import Result
from vdgs.bench.scenes import PUBLISHED, SCENES
from vdgs.bench.seen import seen_truly
from vdgs.bench.statistics import Summary, difference, marks, summarise
from vdgs.bench.tables import TABLES
from vdgs.bench.verdict import verdict
from vdgs.bench.worker import STAGES, Job
from vdgs.bench.writing import escape_latex, escape_markdown, latex, markdown, tidy_csv
from vdgs.cameras import Camera
from vdgs.captures.options import CaptureOptions
from vdgs.config import PRESETS, to_dict
from vdgs.config_checks import validate
from vdgs.errors import VdgsError
from vdgs.verbs.benching import BenchArguments


def total_iterations(method: Method, scene: Scene) -> int:
    config = method.settings(scene.base(scene.budget, 0), scene.budget)
    if "blocks" not in method.stages:
        return config.training.iterations
    return config.training.iterations + config.partition.blocks * config.block.iterations


@pytest.mark.parametrize("scene", SCENES.values(), ids=lambda scene: scene.name)
def test_every_method_works_on_every_scene_and_gets_the_same_iterations(scene):
    for method in METHODS.values():
        config = method.settings(scene.base(scene.budget, 7), scene.budget)
        assert validate(config) == []
        assert config.training.seed == 7
        assert set(method.stages) <= set(STAGES)
        if method.less:
            assert total_iterations(method, scene) < scene.budget.total
            continue
        if method.more:
            assert total_iterations(method, scene) > scene.budget.total
            continue
        assert total_iterations(method, scene) == pytest.approx(scene.budget.total, abs=16), method.name


@pytest.mark.parametrize("table", TABLES.values(), ids=lambda table: table.name)
def test_tables_name_what_exists(table):
    assert set(table.methods) <= METHODS.keys()
    assert set(table.scenes) <= SCENES.keys()
    assert table.ours in table.methods
    assert not table.groups or [name for group in table.groups for name in group.methods] == list(table.methods)
    plan = make_plan(table.name, Choices())
    assert plan.answers.keys() == {
        (scene, method, seed) for scene in table.scenes for method in table.methods for seed in table.seeds
    }
    trained = {run.folder for run in plan.coarse}
    assert all(run.coarse_from in trained for run in plan.runs if "blocks" in run.stages)
    assert len({run.folder for run in plan.runs + plan.coarse}) == len(plan.runs + plan.coarse)


def test_the_command_line_offers_every_table():
    assert set(typing.get_args(typing.get_type_hints(BenchArguments)["table"])) == TABLES.keys()


def test_the_ablations_change_what_they_are_named_after():
    scene = SCENES["residence"]
    base = scene.base(scene.budget, 0)
    settings = {name: method.settings(base, scene.budget) for name, method in METHODS.items()}
    assert settings["full"] == base
    assert (base.training.iterations, base.partition.blocks, base.block.iterations) == (100_000, 8, 50_000)
    assert settings["baseline"].training.iterations == 500_000
    assert not settings["no-blocking"].partition.blocking
    assert settings["no-blocking"].block.compensation.enabled
    off = replace(base.block.compensation, enabled=False)
    assert settings["no-anchor-generation"] == replace(base, block=replace(base.block, compensation=off))
    assert settings["lambda-vis-0"].partition.lambda_vis == 0
    assert settings["t-low-0.3"].block.compensation.t_low == 0.3
    assert settings["beta-g-0.5"].block.compensation.beta_g == 0.5
    assert settings["gamma-0.95"].block.compensation.gamma == 0.95
    assert settings["blocks-16"].block.iterations == 25_000
    # The paper's defaults are the middle of each sweep.
    assert {name for name in TABLES["table4"].methods if settings[name] == base} == {
        "lambda-vis-1", "t-low-0.2", "beta-g-2", "gamma-0.9"
    }  # fmt: skip


def test_blocks_as_printed_take_back_what_the_laptop_changes():
    scene = SCENES["lab-uneven"]
    base = scene.base(scene.budget, 0)
    printed, paper = METHODS["printed"].settings(base, scene.budget), PRESETS["paper"]
    assert printed != base
    assert (printed.block.decoder, printed.block.sampling) == ("frozen", "even")
    assert (printed.block.decoder, printed.block.sampling) == (paper.block.decoder, paper.block.sampling)
    assert printed.assignment.threshold == paper.assignment.threshold == 0.45
    # But for what belongs to the scene.
    block = replace(paper.block, iterations=base.block.iterations, growth=base.block.growth)
    assert printed.block == block
    assert printed.training == base.training
    alone = {
        name: METHODS[name].settings(base, scene.budget)
        for name in (
            "frozen-decoder", "even-sampling", "share-0.45", "printed-rates", "full-size", "last-model",
            "printed-compensation",
        )
    }  # fmt: skip
    assert alone["frozen-decoder"] == replace(base, block=replace(base.block, decoder="frozen"))
    assert alone["even-sampling"] == replace(base, block=replace(base.block, sampling="even"))
    damped = {name: getattr(paper.block, name) for name in ("offset_rate", "scale_rate", "feature_rate")}
    assert alone["printed-rates"] == replace(base, block=replace(base.block, **damped))
    assert alone["full-size"] == replace(base, block=replace(base.block, resolutions=paper.block.resolutions))
    assert alone["last-model"] == replace(base, block=replace(base.block, average=paper.block.average))
    compensation = paper.block.compensation
    assert alone["printed-compensation"] == replace(base, block=replace(base.block, compensation=compensation))
    assert all(each != base for each in alone.values())
    assert alone["share-0.45"] == replace(base, assignment=replace(base.assignment, threshold=0.45))


@pytest.mark.parametrize(("validation", "views"), [(False, "Test views"), (True, "Validation views")])
def test_a_table_says_which_views_it_is_measured_on(validation, views):
    results = made({}, seeds=1)
    plan = make_plan("table2", Choices(scenes=("lab-uneven",), methods=("baseline", "full"), validation=validation))
    titles = [grid.title for grid in grids_of(plan, results)]
    assert titles[0].startswith(f"{views}, raw")
    assert titles[1].startswith(f"{views}, colour-corrected")


def test_methods_that_get_more_are_no_rivals():
    plan = make_plan("longer", Choices(scenes=("lab-even",)))
    results = [
        Result("lab-even", name, seed, "done", figures={"psnr": psnr})
        for name, psnr in (("baseline", 20.95), ("full", 21.0), ("longer-2", 22.0))
        for seed in range(3)
    ]
    (line,) = verdict(plan, results)
    assert line.answer is True
    assert "longer" not in str(line)
    assert "times as long" not in str(line)


def test_a_sweep_of_t_low_is_not_overruled_by_the_quantile_of_the_laptop():
    scene = SCENES["lab-uneven"]
    assert scene.base(scene.budget, 0).block.compensation.t_low_quantile > 0
    config = METHODS["t-low-0.05"].settings(scene.base(scene.budget, 0), scene.budget)
    assert (config.block.compensation.t_low, config.block.compensation.t_low_quantile) == (0.05, 0.0)


def test_runs_with_the_same_settings_are_one_run():
    plan = make_plan("table4", Choices(scenes=("residence",)))
    defaults = [plan.answers["residence", name, 0] for name in ("lambda-vis-1", "t-low-0.2", "beta-g-2", "gamma-0.9")]
    assert len({run.folder for run in defaults}) == 1
    assert len(plan.runs) == 16 - 3
    assert len(plan.coarse) == 1


def test_a_setting_that_came_later_leaves_older_runs_finished(monkeypatch):
    def keys() -> list[str]:
        made = make_plan("table2", Choices(scenes=("residence",), seeds=1))
        return [f"{run.folder} {run.key({}, {})}" for run in made.coarse + made.runs]

    def of_then(config) -> dict:
        settings = to_dict(config)  # of everything, or of the coarse stage alone
        for part in (settings, settings.get("training", {}), settings.get("block", {})):
            part.pop("average", None)
        return settings

    now = keys()
    assert len(now) > 3
    monkeypatch.setattr("vdgs.bench.plan.to_dict", of_then)
    assert keys() == now


def test_the_coarse_row_trains_nothing_of_its_own():
    plan = make_plan("table2", Choices(scenes=("tiny",), seeds=1))
    (shared,) = plan.coarse
    assert plan.answers["tiny", "coarse", 0].coarse_from == shared.folder
    assert plan.answers["tiny", "coarse-as-long", 0].coarse_from is None
    assert plan.answers["tiny", "baseline", 0].coarse_from is None


def test_a_shared_coarse_stage_does_not_depend_on_the_methods_asked_for():
    some, others = (
        make_plan("table1", Choices(scenes=("tiny",), seeds=1, methods=methods)).coarse
        for methods in (("no-blocking", "full"), ("dogs", "blocks-4", "3dgs"))
    )
    assert some == others
    assert len(some) == 1


def test_choices_change_the_budget_for_all_alike():
    plan = make_plan("table2", Choices(scenes=("tiny",), seeds=2, iterations_total=1200, max_anchors=1000))
    assert plan.budgets["tiny"] == Budget(600, 2, 300)
    assert plan.seeds == (0, 1)
    full = plan.answers["tiny", "full", 1].config
    # Growth starts later in proportion, as block.scale_iterations does it.
    assert (full.training.growth.start, full.block.growth.start) == (200, 100)
    assert (full.training.growth.max_anchors, full.block.growth.max_anchors) == (1000, 500)
    assert plan.answers["tiny", "no-blocking", 1].config.block.growth.max_anchors == 1000
    for wrong in (Choices(scenes=("nowhere",)), Choices(methods=("magic",)), Choices(seeds=0),
                  Choices(scale_iterations=0.0)):  # fmt: skip
        with pytest.raises(VdgsError):
            make_plan("table2", wrong)


def test_the_paper_is_quoted_as_printed():
    table = QUOTED["table1"]
    assert table["VDGS"]["residence"] == (24.03, 0.845, 0.188)
    assert table["Momentum-GS"]["block-all"] == (29.11, 0.881, 0.180)
    assert QUOTED["table2"]["(d) Full"]["residence"] == QUOTED["table3"]["4 blocks"]["residence"]
    assert {scene for row in table.values() for scene in row} == set(PUBLISHED)
    titles = {METHODS[name].title for name in TABLES["table4"].methods}
    assert QUOTED["table4"].keys() == titles - {"β_g = 0.1"}  # ours, not in the paper


def test_mean_and_spread():
    assert summarise([1.0, 2.0, 3.0]) == Summary(2.0, 1.0, 3)
    assert summarise([2.5, None, math.nan]) == Summary(2.5, None, 1)
    assert summarise([None]) is None
    both = difference({0: 2.0, 1: 3.0, 2: None}, {0: 1.0, 1: 1.0, 3: 9.0})
    assert both is not None
    assert (both.mean, both.seeds) == (1.5, 2)
    assert both.spread == pytest.approx(math.sqrt(0.5))
    assert both.beyond_spread
    one = difference({0: 2.0}, {0: 1.0})
    assert one is not None
    assert one.beyond_spread is None
    assert difference({0: 1.0}, {1: 1.0}) is None


def test_marks():
    assert marks([1.0, 3.0, 2.0, None], 2) == ["", "best", "second", ""]
    assert marks([1.0, 3.0, 2.0], 2, higher_is_better=False) == ["best", "", "second"]
    assert marks([1.001, 1.004, 0.5], 2) == ["best", "best", "second"]  # equal as shown
    assert marks([1.0, None], 2) == ["", ""]


@given(st.lists(st.none() | st.floats(-50, 50), max_size=12), st.integers(0, 3))
def test_no_value_without_mark_is_above_one_with_it(values, digits):
    given_marks = marks(values, digits)
    shown = [None if value is None else round(value, digits) for value in values]
    best = [value for value, mark in zip(shown, given_marks, strict=True) if mark == "best"]
    second = [value for value, mark in zip(shown, given_marks, strict=True) if mark == "second"]
    rest = [value for value, mark in zip(shown, given_marks, strict=True) if not mark and value is not None]
    assert all(a > b for a in best for b in second + rest)
    assert all(a > b for a in second for b in rest)


def made(gains: dict[str, tuple[float, float]], seeds: int = 3, method_failed: str = "") -> list[Result]:
    """Results on `lab-uneven` with PSNR 20 in all four groups, plus `gains` in the least and the best seen."""
    bounds = tuple({"lower": float(i), "upper": float(i + 1), "pixels": 10} for i in range(4))
    results = []
    for name, (least, best) in gains.items():
        for seed in range(seeds):
            figures = {f"psnr@{i}": 20.0 + 0.1 * seed for i in range(4)} | {"psnr": 20.0, "ssim": 0.5}
            figures["psnr@0"] += least
            figures["psnr@3"] += best
            figures |= {f"psnr_cc@{i}": figures[f"psnr@{i}"] for i in range(4)}
            failed = name == method_failed
            results.append(
                Result("lab-uneven", name, seed, "failed", "it | broke", "runs/x")
                if failed
                else Result("lab-uneven", name, seed, "done", "", "runs/x", figures, bounds, "truth")
            )
    return results


def answers(results: list[Result], **choices) -> list[bool | None]:
    plan = make_plan("table2", Choices(scenes=("lab-uneven",), methods=("baseline", "full"), **choices))
    return [line.answer for line in verdict(plan, results)]


def test_the_verdict_asks_for_more_than_the_spread_and_allows_a_tenth():
    nothing = {"baseline": (0.0, 0.0)}
    assert answers(made(nothing | {"full": (0.5, -0.05)})) == [True, True]
    assert answers(made(nothing | {"full": (0.09, -0.11)})) == [False, False]  # the spread of seeds is 0.1
    assert answers(made(nothing | {"full": (0.5, 0.0)}, seeds=1), seeds=1) == [None, True]
    assert answers(made(nothing | {"full": (0.5, 0.0)}, method_failed="full")) == [None]


def test_rows_that_are_the_same_run_are_not_compared():
    plan = make_plan("table4", Choices(scenes=("residence",)))
    assert len(verdict(plan, [])) == 16 - 4  # lambda-vis-1 is what the three other defaults are, too


def test_an_even_scene_is_judged_against_the_best():
    plan = make_plan("table2", Choices(scenes=("lab-even",)))
    results = [
        Result("lab-even", name, seed, "done", figures={"psnr": psnr})
        for name, psnr in (("baseline", 21.0), ("full", 20.85), ("no-blocking", 20.0))
        for seed in plan.seeds
    ]
    (line,) = verdict(plan, results)
    assert line.answer is False
    assert "21.00" in str(line)


@given(st.text(alphabet="a|_*`<>[]{}#\\\n&%$~^ λ±↑", max_size=20))
def test_escaped_text_has_no_markup(text):
    plain = re.sub(r"\\([\\`*_{}\[\]<>|#])", "", escape_markdown(text))
    assert not set(plain) & set("\\`*_{}[]<>|#\n")
    bare = re.sub(r"\\text\w+\{\}|\$\\\w+\$|\\[{}_%&#$]", "", escape_latex(text))
    assert not set(bare) & set("\\{}_%&#$~^<>\n")


def test_escapes_read_well():
    assert escape_latex("λ_vis = 0.5 & T_low_x") == r"$\lambda_{\mathrm{vis}}$ = 0.5 \& $T_{\mathrm{low}}$\_x"
    assert escape_markdown("a|b_c") == r"a\|b\_c"


def test_grids_are_written_in_every_form():
    cells = (Cell(Summary(24.034, 0.051, 3), 2, "best"), Cell(Summary(23.0, None, 1), 2, "second"), Cell(None, 2))
    grid = Grid("g", "Title_1", ("a", "b|c", "d"), (Row("head"), Row("x_y", cells)), ("a note",))
    text = markdown([grid], "H", [])
    assert r"| x\_y | **24.03 ± 0.05** | <u>23.00</u> | – |" in text
    assert r"\textbf{24.03 $\pm$ 0.05} & \underline{23.00} & --" in latex([grid])
    rows = list(csv.DictReader(io.StringIO(tidy_csv([grid]))))
    assert [(row["group"], row["column"], row["mark"]) for row in rows] == [
        ("head", "a", "best"),
        ("head", "b|c", "second"),
    ]
    assert float(rows[0]["mean"]) == 24.034


def test_failures_are_shown_and_leave_a_gap(tmp_path):
    plan = make_plan("table2", Choices(scenes=("lab-uneven",), methods=("baseline", "full")))
    results = made({"baseline": (0, 0), "full": (1, 0)}, method_failed="full")
    text = markdown(grids_of(plan, results), "T", notes_of(plan, results, verdict(plan, results), False))
    assert "full on lab-uneven, seed 2: failed. it \\| broke" in text
    assert re.search(r"\| VDGS \(full\) \| – \|", text)
    assert draw_groups(tmp_path / "groups.png", plan, results)
    assert not draw_groups(tmp_path / "none.png", plan, [])
    assert not (tmp_path / "none.png").exists()


def test_groups_have_names():
    assert group_names(4) == ["least seen quarter", "quarter 2", "quarter 3", "best seen quarter"]
    assert group_names(1) == ["all pixels"]


def test_a_failed_run_stops_only_those_that_build_on_it(tmp_path):
    files = [tmp_path / f"{name}.json" for name in "abc"]
    Job(tmp_path / "nowhere", {}, {}, ("coarse",), tmp_path / "run", None, "k", None, 4, 1, 1).write(files[0])
    tasks = [Task(file.stem, file, file.with_suffix(".log")) for file in files]
    tasks[1] = replace(tasks[1], after="a")
    told = []
    ended = run_tasks(tasks, 1, lambda name, result: told.append((name, result and result.state)))
    assert {name: end.state for name, end in ended.items()} == {"a": "failed", "b": "failed", "c": "failed"}
    assert "nowhere" in ended["a"].why
    assert ended["b"].why.startswith("a failed")
    assert "c.json" in ended["c"].why
    assert ("b", None) not in told  # it was never started
    assert ("c", None) in told


SMALL = ("--methods", "baseline", "full", "--scale-iterations", "0.1", "--jobs", "2")


def settings(output: Path, scale: float = 0.1) -> BenchSettings:
    """The same in this process."""
    return BenchSettings("toy", output, Choices(methods=("baseline", "full"), scale_iterations=scale), jobs=2)


@pytest.fixture(scope="module")
def benched(tmp_path_factory) -> Path:
    pytest.importorskip("embreex")
    output = tmp_path_factory.mktemp("bench") / "out"
    started = subprocess.Popen(
        [sys.executable, "-m", "vdgs.cli", "bench", "toy", "--output", str(output), *SMALL],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    until = time.monotonic() + 100  # killed without a word once the first run is there; then continued
    while not list(output.glob("runs/tiny/*/0/config.yaml")) and started.poll() is None and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(started.pid, signal.SIGKILL)
    started.communicate()
    time.sleep(1.5)  # its processes notice, save and end
    run_bench(settings(output), Console(file=io.StringIO()))
    return output


def models(output: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in output.rglob("*.safetensors")}


def test_a_bench_that_was_killed_continues_to_its_tables(benched):
    results = json.loads((benched / "toy" / "results.json").read_text())
    assert [(each["method"], each["state"]) for each in results["results"]] == [("baseline", "done"), ("full", "done")]
    assert {each["figures"]["iterations"] for each in results["results"]} == {60}
    for each in results["results"]:
        assert 5 < each["figures"]["psnr"] < 40
        assert each["figures"]["psnr@0"] is not None
        assert each["figures"]["seconds"] > 0
    groups = [each["groups"] for each in results["results"]]
    assert groups[0] == groups[1]  # the same pixels
    assert "**" in (benched / "toy" / "table.md").read_text()
    for name in ("table.tex", "table.csv", "verdict.txt", "groups.png"):
        assert (benched / "toy" / name).stat().st_size
    assert len(results["verdict"]) == 2


def test_a_finished_bench_trains_nothing_again(benched):
    before, said = models(benched), io.StringIO()
    run_bench(settings(benched), Console(file=said))
    assert "started" not in said.getvalue()
    assert models(benched) == before
    assert len(before) > 3


def test_a_shared_coarse_stage_is_trained_once(benched):
    (shared,) = benched.glob("runs/tiny/shared-coarse-*/0/coarse")
    taken = benched / "runs" / "tiny" / "full" / "0" / "coarse"
    assert (taken / "model.safetensors").samefile(shared / "model.safetensors")
    assert (taken / "status.json").read_text() == (shared / "status.json").read_text()


def test_other_settings_do_not_discard_what_is_trained(benched):
    before = models(benched)
    with pytest.raises(VdgsError, match=r"training\.iterations: 60 -> 180"):
        run_bench(settings(benched, scale=0.3), Console(file=io.StringIO()))
    assert models(benched) == before


def test_generated_scenes_are_grouped_by_the_true_visibility(benched):
    results = json.loads((benched / "toy" / "results.json").read_text())["results"]
    assert {each["seen_by"] for each in results} == {"truth"}
    root = benched / "captures" / "tiny"
    seen = seen_truly(root, CaptureOptions())
    assert seen is not None
    counted = np.concatenate([seen.visibility_map(view.camera).ravel() for view in seen.capture.test_views])
    assert np.nanmin(counted) >= 1  # what no training camera sees is nobody's fault
    groups = results[0]["groups"]
    assert sum(group["pixels"] for group in groups) == np.isfinite(counted).sum() < len(counted)
    for group in groups:
        assert ((counted >= group["lower"]) & (counted <= group["upper"])).sum() == group["pixels"]
    assert "truly see the surface" in (benched / "toy" / "table.md").read_text()
    assert f"(V {groups[0]['lower']:g} to {groups[0]['upper']:g})" in (benched / "toy" / "verdict.txt").read_text()


def test_the_truth_is_that_of_the_views_that_are_used(benched):
    root = benched / "captures" / "tiny"
    small = seen_truly(root, CaptureOptions(downscale=2.0, validation=True))
    assert small is not None
    assert all(view.name.startswith("validation") for view in small.capture.test_views)
    for view in small.capture.test_views:
        assert small.visibility_map(view.camera).shape == (36, 48) == (view.camera.height, view.camera.width)
    assert seen_truly(root, CaptureOptions(max_images=20)) is None  # fewer train than the truth counts
    assert seen_truly(root, CaptureOptions(split="every")) is None


def test_sky_belongs_to_no_group(benched, tmp_path, monkeypatch):
    seen = seen_truly(benched / "captures" / "tiny", CaptureOptions())
    assert seen is not None

    def with_sky(camera: Camera) -> np.ndarray:
        below = seen.visibility_map(camera).copy()
        below[:10] = np.nan
        return below

    monkeypatch.setattr(bench, "seen_truly", lambda *_: replace(seen, visibility_map=with_sky, identity="with sky"))
    shutil.copytree(benched, tmp_path / "copy")
    pixels = sum(int(np.isfinite(with_sky(view.camera)).sum()) for view in seen.capture.test_views)
    for result in run_bench(settings(tmp_path / "copy"), Console(file=io.StringIO())):
        assert sum(group["pixels"] for group in result.groups) == pixels
        assert result.groups[0]["lower"] is not None


def test_without_truth_pixels_are_grouped_anew_by_a_model(benched, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(benched, copy)
    shutil.rmtree(copy / "captures" / "tiny" / "truth")
    before, said = models(copy), io.StringIO()
    by_model = run_bench(settings(copy), Console(file=said))
    assert {each.seen_by for each in by_model} == {"model"}
    by_truth = json.loads((benched / "toy" / "results.json").read_text())["results"][0]
    assert by_model[0].groups != tuple(by_truth["groups"])
    assert models(copy) == before
    assert "one coarse model draws" in (copy / "toy" / "table.md").read_text()


def test_one_bench_at_a_time_in_a_folder(tmp_path):
    with (tmp_path / ".lock").open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        with pytest.raises(VdgsError, match="another `vdgs bench`"):
            run_bench(settings(tmp_path), Console(file=io.StringIO()))


def test_data_that_is_not_there_is_named(tmp_path):
    asked = BenchSettings("table2", tmp_path, Choices(scenes=("residence",)))
    with pytest.raises(VdgsError, match="--data"):
        run_bench(asked, Console(file=io.StringIO()))
    with pytest.raises(VdgsError, match="residence-pixsfm"):
        run_bench(replace(asked, data=tmp_path), Console(file=io.StringIO()))
