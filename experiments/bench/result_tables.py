"""Results as tables of numbers: rows are methods, columns figures. `table_writers.py` writes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from experiments.bench.definitions import BenchMethod, BenchScene, MethodGroup
from experiments.bench.measure import group_names
from experiments.bench.paper_numbers import METRIC_COLUMNS, PAPER_NUMBERS
from experiments.bench.plan import BenchPlan
from experiments.bench.results import BenchResult
from experiments.bench.statistics import Mark, Summary, rank_marks, summarize
from vdgs.evaluation.by_visibility import format_bounds


@dataclass(frozen=True)
class TableColumn:
    """A figure: `key` of `BenchResult.figures`, shown times `factor`; `better`: +1 higher, -1 lower, 0 neither."""

    title: str
    key: str
    digits: int = 2
    better: int = 1
    factor: float = 1.0
    scene: str | None = None


@dataclass(frozen=True)
class TableCell:
    """A number, or none."""

    summary: Summary | None
    digits: int
    mark: Mark = ""


@dataclass(frozen=True)
class TableRow:
    """A method's numbers; a row without cells is a heading."""

    label: str
    cells: tuple[TableCell, ...] = ()
    #: In the last column of an overview: whole, adapted and how, quoted, or why the row has no figures; and how many
    #: seeds the figures are of where some are missing.
    rests_on: str = ""


@dataclass(frozen=True)
class ResultTable:
    """A table with a name for files and machines and a title for people."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...] = ()


QUALITY_COLUMNS = (
    TableColumn("PSNR ↑", "psnr"),
    TableColumn("SSIM ↑", "ssim", 3),
    TableColumn("LPIPS ↓", "lpips_vgg", 3, -1),
)
CORRECTED_COLUMNS = (
    TableColumn("PSNR ↑", "psnr_cc"),
    TableColumn("SSIM ↑", "ssim_cc", 3),
    TableColumn("LPIPS ↓", "lpips_vgg_cc", 3, -1),
)
#: What the figures of an overview are of.
OVERVIEW_NOTE = (
    "Corrected: after the color correction that the paper reports, fitted on the test view itself. By visibility: not "
    "corrected. Methods that fit exposures are drawn as their neighbors in the flight: see the table in neutral colors."
)
#: Of an overview, beside quality and PSNR where least and best seen.
OVERVIEW_COST_KEYS = ("iterations", "anchors", "gaussians", "seconds", "peak_memory_bytes")
REFERENCE_EXPOSURE_COLUMNS = (
    TableColumn("PSNR ↑", "psnr_reference_exposure"),
    TableColumn("SSIM ↑", "ssim_reference_exposure", 3),
)
COST_COLUMNS = (
    TableColumn("iterations", "iterations", 0, 0),
    TableColumn("photographs drawn", "photographs", 0, 0),
    TableColumn("anchors", "anchors", 0, 0),
    TableColumn("Gaussians", "gaussians", 0, 0),
    TableColumn("blocks", "blocks", 0, 0),
    TableColumn("cameras a block", "cameras_per_block", 0, 0),
    TableColumn("training s", "seconds", 0, 0),
    TableColumn("of it besides steps s", "preparation_seconds", 0, 0),
    TableColumn("blocks s", "block_seconds", 0, 0),
    TableColumn("longest block s", "longest_block_seconds", 0, 0),
    TableColumn("block memory GB", "block_memory_bytes", 2, 0, 1e-9),
    TableColumn("peak memory GB", "peak_memory_bytes", 2, 0, 1e-9),
    TableColumn("model MB", "model_bytes", 1, 0, 1e-6),
    TableColumn("frames/s", "fps", 0, 0),
)
COVERAGE_COLUMNS = (
    TableColumn("opaque % ↑", "opacity_coverage", factor=100.0),
    TableColumn("PSNR, own background ↑", "psnr_covered_own_background"),
    TableColumn("PSNR, black ↑", "psnr_covered_black"),
    TableColumn("PSNR, white ↑", "psnr_covered_white"),
    TableColumn("error of expected depth % ↓", "depth_error_median_expected", 2, -1, 100.0),
    TableColumn("error of median depth % ↓", "depth_error_median_median", 2, -1, 100.0),
    TableColumn("expected depth within 1 %, % ↑", "depth_within_1_percent_expected", 1, 1, 100.0),
    TableColumn("median depth within 1 %, % ↑", "depth_within_1_percent_median", 1, 1, 100.0),
    TableColumn("large splats ↓", "oversized_splats", 0, -1),
)
#: What makes rows comparable that are exposed and rows that are not.
REFERENCE_EXPOSURE_NOTE = (
    "All methods in the colors of one exposure for the whole place. Raw figures of methods that fit exposures are of "
    "views drawn as their neighbors in the flight are exposed; those of the others are the same here as there."
)
#: Over which pixels, and what the columns hold.
COVERAGE_NOTE = (
    "Over the pixels whose place at least 3 training cameras hold in their frustum, as the coarse model of each run "
    "draws it, or, of methods without one, the measured model itself. So floaters hide themselves: one close before a "
    "test camera, where fewer cameras look, takes what it covers out of the count. Opaque: alpha of at least 0.95. "
    "Error of depth: the median over these pixels, in percent of the camera height; what is not drawn counts as "
    "infinitely far off. Large: longer than the picture, summed over the views."
)
#: An anchor is no Gaussian: what the two columns of sizes hold.
SIZE_NOTE = (
    "Gaussians: of 3DGS its own; of methods with anchors at most as many as these decode to, those without opacity "
    "included, which are not drawn. 3DGS has no anchors."
)
#: What V is.
VISIBILITY_SOURCE_NOTES = {
    "truth": "Training cameras that truly see the surface at a pixel, with occlusion (sky, and what none sees, belongs "
    "to no group)",
    "frusta": "Training cameras whose frustum holds the true surface at a pixel, hidden or not, as the paper counts V",
    "model": "Training cameras whose frustum holds the place that one coarse model draws at a pixel",
}


def make_result_tables(plan: BenchPlan, results: Sequence[BenchResult]) -> list[ResultTable]:
    """Quality raw, corrected and, where views are drawn exposed, neutral over all scenes; by visibility, solidity and
    cost for each scene; the paper's own numbers."""
    across = "mean ± standard deviation over seeds" if len(plan.seeds) > 1 else "one seed"
    views = "Validation views" if plan.validation else "Test views"
    unseen = _unseen(plan, results)
    tables = [_overview(plan, results, scene) for scene in plan.scenes if plan.table.overview]
    tables += [
        _measured(plan, results, "raw", f"{views}, raw ({across})", _for_scenes(plan, QUALITY_COLUMNS), unseen),
        _measured(
            plan,
            results,
            "corrected",
            f"{views}, color-corrected ({across})",
            _for_scenes(plan, CORRECTED_COLUMNS),
            unseen,
        ),
        *_neutral(plan, results, f"{views}, neutral colors ({across})"),
    ]
    for scene in plan.scenes:
        in_scene = [result for result in results if result.scene == scene.name]
        columns, notes = _group_columns(in_scene, scene.name)
        if columns:
            title = f"{scene.title}: PSNR by visibility"
            tables.append(_measured(plan, in_scene, f"visibility-{scene.name}", title, columns, notes))
        columns, notes = _frusta_columns(in_scene, scene.name)
        if columns:
            title = f"{scene.title}: PSNR by visibility as the paper counts it"
            tables.append(_measured(plan, in_scene, f"frusta-{scene.name}", title, columns, notes))
        columns = [
            _for_scene(c, scene.name)
            for c in COVERAGE_COLUMNS
            if any(r.figures.get(c.key) is not None for r in in_scene)
        ]
        if columns:
            title = f"{scene.title}: solidity"
            tables.append(_measured(plan, in_scene, f"solidity-{scene.name}", title, columns, (COVERAGE_NOTE,)))
        columns = [_for_scene(c, scene.name) for c in COST_COLUMNS]
        title = f"{scene.title}: what each method got"
        tables.append(_measured(plan, in_scene, f"costs-{scene.name}", title, columns, (SIZE_NOTE,)))
    from_paper = _paper_table(plan)
    return tables + ([from_paper] if from_paper else [])


def _overview(plan: BenchPlan, results: Sequence[BenchResult], scene: BenchScene) -> ResultTable:
    """Everything of a scene in one table, and what each row rests on; quoted rows, and why a row failed."""
    in_scene = [result for result in results if result.scene == scene.name]
    groups = next((len(result.groups) for result in in_scene if result.groups), 0)
    ends = [(group_names(groups)[i], i) for i in sorted({0, groups - 1})] if groups else []
    corrected = [replace(column, title=f"corrected {column.title}") for column in CORRECTED_COLUMNS]
    columns = [
        *QUALITY_COLUMNS[:2],
        *corrected,
        *(TableColumn(f"PSNR {name} ↑", f"psnr@{index}") for name, index in ends),
        *(column for column in COST_COLUMNS if column.key in OVERVIEW_COST_KEYS),
    ]
    table = _measured(
        plan, in_scene, f"overview-{scene.name}", f"{scene.title}: {plan.table.title}",
        [_for_scene(column, scene.name) for column in columns], (OVERVIEW_NOTE, SIZE_NOTE),
    )  # fmt: skip
    rests_on = {
        method.title: _rests_on(method, [result for result in in_scene if result.method == method.name])
        for method in plan.methods
    }
    rows = [replace(row, rests_on=rests_on[row.label] if row.cells else "") for row in table.rows]
    rows += [_quoted_row(plan, name, scene, columns) for name in plan.table.quoted]
    return replace(table, rows=tuple(rows))


def _rests_on(method: BenchMethod, seeds: Sequence[BenchResult]) -> str:
    """What the figures of a method on a scene rest on, or why there are none; `seeds`: its results."""
    unfinished = [each for each in seeds if each.state != "done"]
    if not unfinished:
        return method.rests_on
    if len(unfinished) == len(seeds):
        return unfinished[-1].reason or unfinished[-1].state
    return f"{method.rests_on}; {len(seeds) - len(unfinished)} of {len(seeds)} seeds"


def _quoted_row(plan: BenchPlan, name: str, scene: BenchScene, columns: Sequence[TableColumn]) -> TableRow:
    """A row of the paper's own, whose figures are color-corrected; dashes on scenes that the paper has not."""
    known = PAPER_NUMBERS.get(plan.table.name, {}).get(name, {}).get(scene.name)
    figures = dict(zip((column.key for column in CORRECTED_COLUMNS), known or (), strict=False))
    cells = [
        TableCell(Summary(figures[column.key], None, 1) if column.key in figures else None, column.digits)
        for column in columns
    ]
    return TableRow(name, tuple(cells), "quoted" if known else "quoted, for the paper's own scenes only: see below")


def _neutral(plan: BenchPlan, results: Sequence[BenchResult], title: str) -> list[ResultTable]:
    """Quality in neutral colors, of all methods; nothing where no method is measured in others."""
    if all(result.figures.get("psnr_reference_exposure") is None for result in results):
        return []
    in_neutral = [replace(result, figures=_in_neutral_colors(result.figures)) for result in results]
    return [
        _measured(
            plan,
            in_neutral,
            "neutral",
            title,
            _for_scenes(plan, REFERENCE_EXPOSURE_COLUMNS),
            (REFERENCE_EXPOSURE_NOTE,),
        )
    ]


def _in_neutral_colors(figures: Mapping[str, float | None]) -> Mapping[str, float | None]:
    """The figures with those in neutral colors, which are the raw ones where nothing else is said."""
    if figures.get("psnr_reference_exposure") is not None:
        return figures
    return {**figures, "psnr_reference_exposure": figures.get("psnr"), "ssim_reference_exposure": figures.get("ssim")}


def _for_scene(column: TableColumn, scene: str) -> TableColumn:
    return replace(column, scene=scene)


def _for_scenes(plan: BenchPlan, columns: Sequence[TableColumn]) -> list[TableColumn]:
    several = len(plan.scenes) > 1
    return [
        TableColumn(
            f"{scene.title}: {c.title}" if several else c.title, c.key, c.digits, c.better, c.factor, scene.name
        )
        for scene in plan.scenes
        for c in columns
    ]  # fmt: skip


def _unseen(plan: BenchPlan, results: Sequence[BenchResult]) -> tuple[str, ...]:
    """What the figures over all pixels hold that no training camera sees, scene by scene."""
    shares = {}
    for scene in plan.scenes:
        known = [result.figures.get("unseen_share") for result in results if result.scene == scene.name]
        share = next((each for each in known if each is not None), None)
        if share is not None:
            shares[scene.title] = share
    if not shares:
        return ()
    listed = "; ".join(f"{title}: {share:.1%}" for title, share in shares.items())
    return (f"Over all pixels, of which no training camera sees: {listed}. There every method only guesses.",)


def _frusta_columns(results: Sequence[BenchResult], scene: str) -> tuple[list[TableColumn], tuple[str, ...]]:
    """PSNR of each group by V as frusta count it, least seen first; how the groups are bounded."""
    groups = next((result.frusta for result in results if result.frusta), ())
    if not groups:
        return [], ()
    names = group_names(len(groups))
    columns = [TableColumn(f"{name} ↑", f"psnr@frusta{index}", scene=scene) for index, name in enumerate(names)]
    bounds = "; ".join(f"{name}: V {group_bounds(group)}" for name, group in zip(names, groups, strict=True))
    return columns, (f"V: {VISIBILITY_SOURCE_NOTES['frusta']}. Pooled over all these views: {bounds}.",)


def _group_columns(results: Sequence[BenchResult], scene: str) -> tuple[list[TableColumn], tuple[str, ...]]:
    """PSNR of each group, least seen first, raw and corrected for the ends; how the groups are bounded."""
    first = next((result for result in results if result.groups), None)
    groups = first.groups if first else ()
    names = group_names(len(groups)) if groups else []
    columns = [TableColumn(f"{name} ↑", f"psnr@{index}", scene=scene) for index, name in enumerate(names)]
    columns += [
        TableColumn(f"{names[index]}, corrected ↑", f"psnr_cc@{index}", scene=scene)
        for index in sorted({0, len(names) - 1})
        if names
    ]
    if first is None:
        return columns, ()
    source = VISIBILITY_SOURCE_NOTES[first.visibility_source]
    return columns, (f"V: {source}. Pooled over all these views: {all_group_bounds(first)}.",)


def all_group_bounds(result: BenchResult) -> str:
    """The V of every group of a result, least seen first."""
    names = group_names(len(result.groups))
    return "; ".join(f"{name}: V {group_bounds(group)}" for name, group in zip(names, result.groups, strict=True))


def group_bounds(group: Mapping[str, Any]) -> str:
    """Least and greatest V of a group."""
    return format_bounds(group["lower"], group["upper"])


def _measured(
    plan: BenchPlan, results: Sequence[BenchResult], name: str, title: str, columns: Sequence[TableColumn],
    notes: tuple[str, ...] = (),
) -> ResultTable:  # fmt: skip
    """Rows in the order of the table's groups, marks within a group."""
    titles = {method.name: method.title for method in plan.methods}
    rows: list[TableRow] = []
    shown = set()
    # Methods that were asked for by name come in that order, unless the table has groups of its own.
    headings = plan.table.groups or (MethodGroup("", tuple(titles)),)
    for group in headings:
        members = [method for method in group.methods if method in titles]
        shown |= set(members)
        rows += _rows_of_group(group.title, members, titles, results, columns)
    extra = [method for method in titles if method not in shown]
    rows += _rows_of_group("" if not rows else "others", extra, titles, results, columns) if extra else []
    return ResultTable(name, title, tuple(column.title for column in columns), tuple(rows), notes)


def _rows_of_group(
    title: str,
    methods: Sequence[str],
    titles: dict[str, str],
    results: Sequence[BenchResult],
    columns: Sequence[TableColumn],
) -> list[TableRow]:
    table = [[_summary(results, method, column) for column in columns] for method in methods]
    marked = [
        rank_marks([None if row[i] is None else row[i].mean for row in table], column.digits, column.better > 0)  # type: ignore[union-attr]
        if column.better
        else [""] * len(methods)
        for i, column in enumerate(columns)
    ]
    rows = [TableRow(title)] if title and methods else []
    for index, method in enumerate(methods):
        cells = tuple(
            TableCell(table[index][i], column.digits, marked[i][index])  # type: ignore[arg-type]
            for i, column in enumerate(columns)
        )  # fmt: skip
        rows.append(TableRow(titles[method], cells))
    return rows


def _summary(results: Sequence[BenchResult], method: str, column: TableColumn) -> Summary | None:
    chosen: Callable[[BenchResult], bool] = lambda each: each.method == method and each.scene == column.scene  # noqa: E731
    values = [each.figures.get(column.key) for each in results if chosen(each)]
    return summarize(None if value is None else column.factor * value for value in values)


def _paper_table(plan: BenchPlan) -> ResultTable | None:
    """The paper's numbers for its scenes; all of them, whichever scenes were run, so that they are never mixed up."""
    rows = PAPER_NUMBERS.get(plan.table.name)
    if not rows:
        return None
    scenes = list(dict.fromkeys(scene for row in rows.values() for scene in row))
    columns = tuple(f"{scene}: {name}" for scene in scenes for name in METRIC_COLUMNS)
    table_rows = []
    for label, row in rows.items():
        cells = [
            TableCell(Summary(row[scene][i], None, 1), 4 if digits == 4 and i else (2 if i == 0 else 3))
            if scene in row else TableCell(None, 2)
            for scene in scenes for i, digits in enumerate([2, 4, 4] if plan.table.name == "table4" else [2, 3, 3])
        ]  # fmt: skip
        table_rows.append(TableRow(label, tuple(cells)))
    return ResultTable(
        "quoted", "Quoted from the paper (its data, its hardware; not measured here)", columns, tuple(table_rows)
    )
