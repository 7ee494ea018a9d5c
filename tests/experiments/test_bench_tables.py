"""From results to tables: statistics, marks, claim checks, and what is written."""

import csv
import io
import math
import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.bench.bench import BenchSettings, ProgressReporter, run_bench
from experiments.bench.claim_check import check_claims
from experiments.bench.equal_time import step_factors
from experiments.bench.figure import plot_visibility_groups
from experiments.bench.measure import group_names
from experiments.bench.methods import METHODS
from experiments.bench.notes import make_notes
from experiments.bench.plan import PlanOptions, make_plan
from experiments.bench.result_tables import ResultTable, TableCell, TableRow, make_result_tables
from experiments.bench.results import BenchResult
from experiments.bench.statistics import Summary, paired_difference, rank_marks, summarize
from experiments.bench.table_writers import escape_latex, escape_markdown, to_latex, to_markdown, to_tidy_csv
from vdgs.distributed.executor import Task
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.errors import VdgsError


def test_mean_and_spread():
    assert summarize([1.0, 2.0, 3.0]) == Summary(2.0, 1.0, 3)
    assert summarize([2.5, None, math.nan]) == Summary(2.5, None, 1)
    assert summarize([None]) is None
    both = paired_difference({0: 2.0, 1: 3.0, 2: None}, {0: 1.0, 1: 1.0, 3: 9.0})
    assert both is not None
    assert (both.mean, both.by_seed) == (1.5, (1.0, 2.0))
    assert both.spread == pytest.approx(math.sqrt(0.5))
    assert both.exceeds_spread
    one = paired_difference({0: 2.0}, {0: 1.0})
    assert one is not None
    assert one.exceeds_spread is None
    assert paired_difference({0: 1.0}, {1: 1.0}) is None


def test_marks():
    assert rank_marks([1.0, 3.0, 2.0, None], 2) == ["", "best", "second", ""]
    assert rank_marks([1.0, 3.0, 2.0], 2, higher_is_better=False) == ["best", "", "second"]
    assert rank_marks([1.001, 1.004, 0.5], 2) == ["best", "best", "second"]  # equal as shown
    assert rank_marks([1.0, None], 2) == ["", ""]


@given(st.lists(st.none() | st.floats(-50, 50), max_size=12), st.integers(0, 3))
def test_no_value_without_mark_is_above_one_with_it(values, digits):
    given_marks = rank_marks(values, digits)
    shown = [None if value is None else round(value, digits) for value in values]
    best = [value for value, mark in zip(shown, given_marks, strict=True) if mark == "best"]
    second = [value for value, mark in zip(shown, given_marks, strict=True) if mark == "second"]
    rest = [value for value, mark in zip(shown, given_marks, strict=True) if not mark and value is not None]
    assert all(a > b for a in best for b in second + rest)
    assert all(a > b for a in second for b in rest)


def results_with(gains: dict[str, tuple[float, float]], seeds: int = 3, method_failed: str = "") -> list[BenchResult]:
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
                BenchResult("lab-uneven", name, seed, "failed", "it | broke", "runs/x")
                if failed
                else BenchResult("lab-uneven", name, seed, "done", "", "runs/x", figures, bounds, "truth")
            )
    return results


def answers(results: list[BenchResult], **choices) -> list[bool | None]:
    plan = make_plan("table2", PlanOptions(scenes=("lab-uneven",), methods=("baseline", "full"), **choices))
    return [line.answer for line in check_claims(plan, results)]


def test_a_claim_check_asks_for_more_than_the_spread_and_allows_a_tenth():
    nothing = {"baseline": (0.0, 0.0)}
    assert answers(results_with(nothing | {"full": (0.5, -0.05)})) == [True, True]
    assert answers(results_with(nothing | {"full": (0.09, -0.11)})) == [False, False]  # the spread of seeds is 0.1
    assert answers(results_with(nothing | {"full": (0.5, 0.0)}, seeds=1), seeds=1) == [None, True]
    assert answers(results_with(nothing | {"full": (0.5, 0.0)}, method_failed="full")) == [None]
    plan = make_plan("table2", PlanOptions(scenes=("lab-uneven",), methods=("baseline", "full")))
    least, _ = check_claims(plan, results_with(nothing | {"full": (0.5, 0.0)}))
    assert least.numbers == "+0.50 dB, spread 0.10, 3 seeds: +0.50, +0.50, +0.50"  # each against the same seed


def test_rows_that_are_the_same_run_are_not_compared():
    plan = make_plan("table4", PlanOptions(scenes=("residence",)))
    assert len(check_claims(plan, [])) == 17 - 4  # lambda-vis-1 is what the three other defaults are, too


def test_an_even_scene_is_judged_against_the_best():
    plan = make_plan("table2", PlanOptions(scenes=("lab-even",)))
    results = [
        BenchResult("lab-even", name, seed, "done", figures={"psnr": psnr})
        for name, psnr in (("baseline", 21.0), ("full", 20.85), ("no-blocking", 20.0))
        for seed in plan.seeds
    ]
    (line,) = check_claims(plan, results)
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
    cells = (
        TableCell(Summary(24.034, 0.051, 3), 2, "best"),
        TableCell(Summary(23.0, None, 1), 2, "second"),
        TableCell(None, 2),
    )
    grid = ResultTable("g", "Title_1", ("a", "b|c", "d"), (TableRow("head"), TableRow("x_y", cells)), ("a note",))
    text = to_markdown([grid], "H", [])
    assert r"| x\_y | **24.03 ± 0.05** | <u>23.00</u> | – |" in text
    assert r"\textbf{24.03 $\pm$ 0.05} & \underline{23.00} & --" in to_latex([grid])
    rows = list(csv.DictReader(io.StringIO(to_tidy_csv([grid]))))
    assert [(row["group"], row["column"], row["mark"]) for row in rows] == [
        ("head", "a", "best"),
        ("head", "b|c", "second"),
    ]
    assert float(rows[0]["mean"]) == 24.034


def test_solidity_is_a_table_where_it_is_known():
    plan = make_plan("table2", PlanOptions(scenes=("lab-uneven",), methods=("baseline", "full")))
    results = results_with({"baseline": (0, 0), "full": (1, 0)})
    assert not [grid for grid in make_result_tables(plan, results) if grid.name == "solidity-lab-uneven"]
    for result, share in zip(results, (0.5, 0.5, 0.5, 0.9, 0.9, 0.9), strict=True):
        result.figures.update({"opacity_coverage": share, "oversized_splats": None})
    (grid,) = [grid for grid in make_result_tables(plan, results) if grid.name == "solidity-lab-uneven"]
    assert grid.columns == ("opaque % ↑",)
    assert "| VDGS (full) | **90.00 ± 0.00** |" in to_markdown([grid], "T", [])


def test_methods_that_fit_exposures_are_compared_with_others_in_neutral_colors():
    plan = make_plan("table2", PlanOptions(scenes=("lab-uneven",), methods=("baseline", "full")))
    results = results_with({"baseline": (0, 0), "full": (1, 0)})
    assert not [grid for grid in make_result_tables(plan, results) if grid.name == "neutral"]
    for result in results[:3]:
        result.figures.update({"psnr": 20.5, "ssim": 0.61})
    for result in results[3:]:
        result.figures.update({"psnr": 30.0, "ssim": 0.9})
        result.figures.update({"psnr_reference_exposure": 20.25, "ssim_reference_exposure": 0.6})
    (grid,) = [grid for grid in make_result_tables(plan, results) if grid.name == "neutral"]
    text = to_markdown([grid], "T", [])
    assert "| VDGS (full) | <u>20.25 ± 0.00</u> | <u>0.600 ± 0.000</u> |" in text
    assert "| **20.50 ± 0.00** | **0.610 ± 0.000** |" in text


def test_failures_are_shown_and_leave_a_gap(tmp_path):
    plan = make_plan("table2", PlanOptions(scenes=("lab-uneven",), methods=("baseline", "full")))
    results = results_with({"baseline": (0, 0), "full": (1, 0)}, method_failed="full")
    text = to_markdown(
        make_result_tables(plan, results), "T", make_notes(plan, results, check_claims(plan, results), False)
    )
    assert "full on lab-uneven, seed 2: failed. it \\| broke" in text
    assert re.search(r"\| VDGS \(full\) \| – \|", text)
    assert plot_visibility_groups(tmp_path / "groups.png", plan, results)
    assert not plot_visibility_groups(tmp_path / "none.png", plan, [])
    assert not (tmp_path / "none.png").exists()


def test_groups_have_names():
    assert group_names(4) == ["least seen quarter", "quarter 2", "quarter 3", "best seen quarter"]
    assert group_names(1) == ["all pixels"]


@pytest.mark.parametrize(("validation", "views"), [(False, "Test views"), (True, "Validation views")])
def test_a_table_says_which_views_it_is_measured_on(validation, views):
    results = results_with({}, seeds=1)
    plan = make_plan("table2", PlanOptions(scenes=("lab-uneven",), methods=("baseline", "full"), validation=validation))
    titles = [grid.title for grid in make_result_tables(plan, results)]
    assert titles[0].startswith(f"{views}, raw")
    assert titles[1].startswith(f"{views}, color-corrected")


def test_methods_that_get_more_are_no_rivals():
    plan = make_plan("longer", PlanOptions(scenes=("lab-even",)))
    results = [
        BenchResult("lab-even", name, seed, "done", figures={"psnr": psnr})
        for name, psnr in (("baseline", 20.95), ("full", 21.0), ("longer-2", 22.0))
        for seed in range(3)
    ]
    (line,) = check_claims(plan, results)
    assert line.answer is True
    assert "longer" not in str(line)
    assert "times as long" not in str(line)


def test_an_overview_says_what_each_row_rests_on():
    methods = ("3dgs-black", "vastgaussian-whole", "full")
    plan = make_plan("table1", PlanOptions(scenes=("lab-uneven",), methods=methods))
    results = results_with(dict.fromkeys(methods, (0.0, 1.0)), method_failed="3dgs-black")
    for result in results:
        if result.state == "done":
            result.figures.update({"seconds": 12.0, "anchors": 900, "peak_memory_bytes": 5e8})
    overview = make_result_tables(plan, results)[0]
    assert overview.name == "overview-lab-uneven"
    assert "PSNR least seen quarter ↑" in overview.columns
    said = {row.label: row.rests_on for row in overview.rows}
    assert said["3DGS, black background"] == "it | broke"  # why it has no figures
    assert said["VastGaussian"] == said["VDGS (full)"] == "whole"
    assert said["Switch-NeRF"].startswith("quoted")
    text = to_markdown([overview], "T", [])
    assert re.search(r"\| rests on \|\n\|---\|(---:\|)+---\|\n", text)
    assert all(
        line.count("|") - line.count("\\|") == len(overview.columns) + 3
        for line in text.splitlines()
        if line.startswith("|")
    )
    assert r"rests on \\" in to_latex([overview])
    quoted = make_plan("table1", PlanOptions(scenes=("residence",), methods=methods))
    row = make_result_tables(quoted, [])[0].rows[-1]
    figures = [cell.summary and cell.summary.mean for cell in row.cells[:5]]
    assert figures == [None, None, 22.57, 0.654, 0.352]  # the paper's are color-corrected


def test_an_overview_says_of_how_many_seeds_the_figures_are():
    plan = make_plan("table1", PlanOptions(scenes=("lab-uneven",), methods=("full", "baseline", "coarse")))
    finished = results_with(dict.fromkeys(("full", "baseline", "coarse"), (0.0, 0.0)))
    results = [
        replace(each, state="stopped", reason="not started", figures={}, groups=())
        if each.method == "baseline" or (each.method == "full" and each.seed) else each
        for each in finished
    ]  # fmt: skip
    said = {row.label: row.rests_on for row in make_result_tables(plan, results)[0].rows}
    titles = {name: METHODS[name].title for name in ("full", "baseline", "coarse")}
    assert said[titles["full"]] == f"{METHODS['full'].rests_on}; 1 of 3 seeds"
    assert said[titles["baseline"]] == "not started"
    assert said[titles["coarse"]] == METHODS["coarse"].rests_on


def test_a_method_without_a_published_program_is_never_called_whole():
    for name in ("hug", "mixgs", "octree-gs", "momentum-gs", "dogs", "citygaussian", "3dgs-black"):
        assert METHODS[name].rests_on.startswith("adapted: "), name
    assert METHODS["scaffold-gs"].rests_on == "whole"


def test_at_equal_time_dear_methods_make_fewer_iterations():
    methods = ("3dgs-black", "octree-gs", "full")
    plan = make_plan("table1", PlanOptions(scenes=("tiny",), methods=methods, seeds=2))
    seconds = {"3dgs-black": (1.0, 3.0), "octree-gs": (80.0, 80.0), "full": (10.0, 10.0)}
    results = [
        BenchResult("tiny", name, seed, "done", figures={"seconds": taken[seed]})
        for name, taken in seconds.items() for seed in (0, 1)
    ]  # fmt: skip
    factors = step_factors(plan, results)
    assert factors == (("tiny", "3dgs-black", 5.0), ("tiny", "octree-gs", 0.12), ("tiny", "full", 1.0))
    again = make_plan("table1", PlanOptions(scenes=("tiny",), methods=methods, seeds=2, step_factors=factors))
    assert again.run_of["tiny", "full", 0] == plan.run_of["tiny", "full", 0]  # not trained again
    slower, before = again.run_of["tiny", "octree-gs", 0], plan.run_of["tiny", "octree-gs", 0]
    assert slower.config.training.iterations == pytest.approx(0.12 * before.config.training.iterations, abs=2)
    assert slower.folder != before.folder
    assert again.table.title == f"{plan.table.title}, at equal time"
    said = "".join(make_notes(again, [], [], False))
    assert "octree-gs on tiny: 0.12" in said
    assert "decides about growth (few times say little of it): full on tiny: 1." in said
    with pytest.raises(VdgsError, match="takes the time of `full`"):
        step_factors(plan, results[:4])


def test_what_does_not_grow_with_iterations_is_taken_off_before_time_is_shared_out():
    """Of 10 s of `full` 4 are a cut; 2 s of 3DGS are all steps; a cut of 12 s leaves no time for steps."""
    methods = ("3dgs-black", "octree-gs", "full")
    plan = make_plan("table1", PlanOptions(scenes=("tiny",), methods=methods, seeds=1))
    seconds = {"3dgs-black": (2.0, 0.0), "octree-gs": (14.0, 12.0), "full": (10.0, 4.0)}
    results = [
        BenchResult("tiny", name, 0, "done", figures={"seconds": whole, "preparation_seconds": fixed})
        for name, (whole, fixed) in seconds.items()
    ]
    expected = (("tiny", "3dgs-black", 5.0), ("tiny", "octree-gs", 0.05), ("tiny", "full", 1.0))
    assert step_factors(plan, results) == expected


def test_large_scenes_of_a_table_have_one_seed_unless_more_are_asked_for():
    assert {seed for scene, _, seed in make_plan("table1", PlanOptions()).run_of if scene == "seneca"} == {0}
    assert {seed for scene, _, seed in make_plan("table1", PlanOptions()).run_of if scene == "copr"} == {0, 1, 2}
    asked = make_plan("table1", PlanOptions(seeds=2, scenes=("seneca",)))
    assert {seed for _, _, seed in asked.run_of} == {0, 1}


def test_a_line_is_printed_when_a_run_starts_and_one_when_it_ended(tmp_path):
    said = io.StringIO()
    task = Task(name="tiny/full/0", command=["true"], output=tmp_path / "log")
    LocalExecutor(1).run([task], ProgressReporter(1, Console(file=said)))
    assert re.fullmatch(r"started  tiny/full/0\ndone     tiny/full/0  \d+ s  \(1 of 1\) *\n", said.getvalue())


def test_weights_for_lpips_that_are_not_there_are_named_before_anything_is_trained(tmp_path):
    asked = BenchSettings("toy", tmp_path / "out", PlanOptions(), lpips_weights=tmp_path / "vgg.pth")
    with pytest.raises(VdgsError, match=r"vgg\.pth: no such file"):
        run_bench(asked, Console(file=io.StringIO()))
    assert not (tmp_path / "out").exists()
