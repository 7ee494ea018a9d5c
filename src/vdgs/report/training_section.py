"""How training went: curves of the coarse model and of the blocks, and what compensated growth did."""

from __future__ import annotations

from vdgs.plots.partition.block_stats import block_color
from vdgs.report.charts import MERGED_COLOR, Curve, draw_curves
from vdgs.report.formatting import format_db, format_percent, format_value
from vdgs.report.html_page import Html, figure, gallery, heading, join_html, paragraph, section, table
from vdgs.report.run_reader import JsonRecord, ReportedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.system.units import count

#: Log lines over which the loss is smoothed: it is that of a single photograph.
SMOOTHING_WINDOW = 9

#: A name, its colour and its log.
NamedLog = tuple[str, str, list[JsonRecord]]


def list_blocks(run: RunFolder) -> list[tuple[int, str]]:
    """Number and folder (blocks/NN) of every block that was begun."""
    names = [folder.path.name for folder in run.block_folders()]
    return [(int(name), f"blocks/{name}") for name in names if name.isdecimal()]


def training_section(report: ReportedRun) -> Html:
    source, run = report.files(), report.run
    parts = [heading("Coarse model"), _initialization_note(source.record("coarse/start.json"))]
    coarse = source.lines("coarse/log.jsonl")
    parts.append(_curves([("coarse", MERGED_COLOR, coarse)]))
    if not coarse and not source.exists("coarse/log.jsonl"):
        parts.append(paragraph("The coarse model has no log yet.", "absent"))
    parts.append(heading("Blocks"))
    names = list_blocks(run)
    logs = [(f"block {index}", block_color(index), source.lines(f"{name}/log.jsonl")) for index, name in names]
    statuses = [(f"block {index}", source.record(f"{name}/status.json")) for index, name in names]
    parts.append(_curves(logs))
    if any(records for _, _, records in logs):
        parts.append(paragraph("PSNR and loss of a block are those of the parts of photographs that show it.", "facts"))
    elif not source.exists(*(f"{name}/log.jsonl" for _, name in names)):
        parts.append(paragraph("No block has a log yet.", "absent"))
    parts.append(_states([("coarse", source.record("coarse/status.json")), *statuses], report))
    parts += _growth(logs)
    return section("training", "Training", parts, source.notes)


def _initialization_note(record: JsonRecord) -> Html:
    """What was found before the first step."""
    said = []
    if record.number("sparse_points") is not None:
        dense = record.number("dense_points")
        beside = "" if dense is None else f" and {count(dense)} that stereo found"
        said.append(f"It starts from {count(record.number('sparse_points'))} sparse points{beside}.")
    if record.values.get("exposures") in (True, False):
        differ = record.number("brightness_differs")
        known = (
            ""
            if differ is None
            else f"Photographs of the same places differ in brightness by {format_percent(differ)}. "
        )
        said.append(known + ("Each has" if record.values["exposures"] else "None has") + " an exposure of its own.")
    return paragraph(" ".join(said), "facts") if said else Html("")


def _curves(logs: list[NamedLog]) -> Html:
    finer = _resolution_changes(logs[0][2]) if len(logs) == 1 else {}
    marks = list(finer)
    psnr = draw_curves(_series(logs, "psnr_smoothed"), "training PSNR, smoothed (dB)", marked_iterations=marks)
    anchors = draw_curves(_series(logs, "anchors"), "anchors", from_zero=True, marked_iterations=marks)
    title = f"loss (bold: median of {SMOOTHING_WINDOW} log lines)"
    loss = draw_curves(_series(logs, "loss"), title, smoothing_window=SMOOTHING_WINDOW, marked_iterations=marks)
    shown = gallery([figure(psnr, "", "PSNR"), figure(anchors, "", "anchors"), figure(loss, "", "loss")])
    if not finer:
        return shown
    steps = ", ".join(f"1/{downscale:g} from {at:,.0f}" for at, downscale in finer.items())
    return join_html([shown, paragraph(f"Dotted: the photographs get finer, resolution {steps}.", "facts")])


def _resolution_changes(records: list[JsonRecord]) -> dict[float, float]:
    """Iterations at which the resolution changed, with the downscale from there on."""
    changes: dict[float, float] = {}
    before: float | None = None
    for record in records:
        at, downscale = record.number("iteration"), record.number("downscale")
        if at is None or downscale is None:
            continue
        if before not in (None, downscale):
            changes[at] = downscale
        before = downscale
    return changes


def _series(logs: list[NamedLog], key: str, named: bool = True, dashed: bool = False) -> list[Curve]:
    """One curve for each log, of the records that have an iteration and mention the key."""
    curves = []
    for label, color, records in logs:
        points = [
            (at, record.number(key))
            for record in records
            if key in record.values and (at := record.number("iteration")) is not None
        ]
        curves.append(
            Curve(label if named else "", color, [at for at, _ in points], [value for _, value in points], dashed)
        )
    return curves


def _states(statuses: list[tuple[str, JsonRecord]], report: ReportedRun) -> Html:
    rows = []
    for name, status in statuses:
        if not status:
            continue
        done, wanted = status.number("iteration"), status.number("iterations")
        rows.append(
            [name, f"{count(done)} / {count(wanted)}", count(status.number("anchors")),
             format_db(status.number("psnr_training")), report.stage_state(name)]
        )  # fmt: skip
    return table(["", "iterations", "anchors", "PSNR while training (dB)", "state"], rows, wrap_last_column=True)


def _growth(logs: list[NamedLog]) -> list[Html]:
    """Compensated growth (section IV-C), cycle by cycle."""
    cycles = [
        (name, color, found)
        for name, color, records in logs
        if (found := [record for record in records if record.number("low_share") is not None])
    ]
    if not cycles:
        return []
    grown = [*_series(cycles, "grown_low"), *_series(cycles, "grown_other", named=False, dashed=True)]
    limits = _series(cycles, "t_low")
    moving = len({value for curve in limits for value in curve.y}) > 1  # else the table below says it all
    charts = (
        (
            draw_curves(
                _series(cycles, "low_share"), "share of anchors of low visibility", show_markers=True, from_zero=True
            ),
            "share of low visibility",
        ),
        (
            draw_curves(limits if moving else [], "T_low: c_k below it is low", show_markers=True, from_zero=True),
            "T_low",
        ),
        (
            draw_curves(_series(cycles, "mean_cache"), "mean gradient added, g", show_markers=True, from_zero=True),
            "cache",
        ),
        (
            draw_curves(grown, "anchors grown: low, dashed the others", show_markers=True, from_zero=True),
            "anchors grown",
        ),
    )
    return [
        heading("Compensated growth in the blocks"),
        paragraph(
            "In every growth cycle, anchors that few of the cycle's cameras see (c_k below T_low) get gradients of "
            "past cycles added, so that they may grow too. One dot is one cycle."
        ),
        gallery(figure(chart, "", alt) for chart, alt in charts),
        _growth_table(cycles),
    ]


def _growth_table(cycles: list[NamedLog]) -> Html:
    rows = []
    for name, _, records in cycles:
        low, other = (sum(record.number(key) or 0 for record in records) for key in ("grown_low", "grown_other"))
        last = records[-1]
        rows.append(
            [
                name,
                count(len(records)),
                count(low),
                count(other),
                format_percent(low / (low + other)) if low + other else "–",
                format_percent(last.number("low_share")),
                format_value(last.number("t_low"), "{:.3g}"),
                format_value(last.number("mean_cache"), "{:.2e}"),
            ]
        )
    head = ["", "cycles", "grown, low", "grown, other", "of it low", "low share, last", "T_low, last", "mean g, last"]
    return table(head, rows, "Sums over all cycles, and the last cycle")
