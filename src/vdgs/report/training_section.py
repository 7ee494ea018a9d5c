"""How training went (curves, compensated growth), what each stage cost, and the settings."""

from __future__ import annotations

from vdgs.partition.plots.block_colors import block_color
from vdgs.report.charts import MERGED_COLOR, Curve, draw_curves
from vdgs.report.html_page import (
    Html,
    details,
    figure,
    gallery,
    heading,
    join_html,
    paragraph,
    preformatted,
    section,
    table,
)
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles, format_percent
from vdgs.runs.run_folder import RunFolder
from vdgs.system.units import count, data_size, duration

#: Log lines over which the loss is smoothed: it is that of a single photograph.
SMOOTHING_WINDOW = 9
#: Characters of config.yaml that are shown.
MAX_SETTINGS_CHARS = 60_000
COST_CAPTION = "Blocks trained side by side count one by one; what is out of date does not count"

#: A name, its color and its log.
NamedLog = tuple[str, str, list[JsonRecord]]


def list_blocks(run: RunFolder) -> list[tuple[int, str]]:
    """Number and folder (blocks/NN) of every block that was begun."""
    names = [folder.path.name for folder in run.block_folders()]
    return [(int(name), f"blocks/{name}") for name in names if name.isdecimal()]


def training_section(report: ReportedRun) -> Html:
    source, blocks = report.files(), list_blocks(report.run)
    coarse = source.lines("coarse/log.jsonl")
    logs = [(f"block {index}", block_color(index), source.lines(f"{name}/log.jsonl")) for index, name in blocks]
    statuses = [(f"block {index}", source.record(f"{name}/status.json")) for index, name in blocks]
    no_coarse = not coarse and not source.exists("coarse/log.jsonl")
    if any(records for _, _, records in logs):
        note = paragraph("PSNR and loss of a block are those of the parts of photographs that show it.", "facts")
    else:
        is_absent = not source.exists(*(f"{name}/log.jsonl" for _, name in blocks))
        note = paragraph("No block has a log yet." if is_absent else "", "absent")
    parts = [
        heading("Coarse model"),
        _initialization_note(source.record("coarse/initialization.json")),
        _curves([("coarse", MERGED_COLOR, coarse)]),
        paragraph("The coarse model has no log yet." if no_coarse else "", "absent"),
        heading("Blocks"),
        _curves(logs),
        note,
        _states([("coarse", source.record("coarse/status.json")), *statuses], report),
        *_growth(logs),
    ]
    return section("training", "Training", parts, source.notes)


def _initialization_note(record: JsonRecord) -> Html:
    """What was known before the first step."""
    sentences = []
    if record.number("sparse_points") is not None:
        dense = (
            "" if record.number("dense_points") is None else f" and {record.count('dense_points')} that stereo found"
        )
        sentences.append(f"It starts from {record.count('sparse_points')} sparse points{dense}.")
    if record.values.get("exposures") in (True, False):
        differ = record.number("brightness_differs")
        if differ is not None:
            sentences.append(f"Photographs of the same places differ in brightness by {format_percent(differ)}.")
        sentences.append(f"{'Each' if record.values['exposures'] else 'None'} has an exposure of its own.")
    return paragraph(" ".join(sentences), "facts")


def _curves(logs: list[NamedLog]) -> Html:
    changes = _resolution_changes(logs[0][2]) if len(logs) == 1 else {}
    marks = list(changes)
    psnr = draw_curves(_series(logs, "psnr_smoothed"), "training PSNR, smoothed (dB)", marked_iterations=marks)
    anchors = draw_curves(_series(logs, "anchors"), "anchors", from_zero=True, marked_iterations=marks)
    title = f"loss (bold: median of {SMOOTHING_WINDOW} log lines)"
    loss = draw_curves(_series(logs, "loss"), title, smoothing_window=SMOOTHING_WINDOW, marked_iterations=marks)
    shown = gallery([figure(psnr, "", "PSNR"), figure(anchors, "", "anchors"), figure(loss, "", "loss")])
    if not changes:
        return shown
    steps = ", ".join(f"1/{downscale:g} from {iteration:,.0f}" for iteration, downscale in changes.items())
    return join_html([shown, paragraph(f"Dotted: the photographs get finer, resolution {steps}.", "facts")])


def _resolution_changes(records: list[JsonRecord]) -> dict[float, float]:
    """Iterations at which the resolution changed, with the downscale from there on."""
    changes: dict[float, float] = {}
    before: float | None = None
    for record in records:
        iteration, downscale = record.number("iteration"), record.number("downscale")
        if iteration is None or downscale is None:
            continue
        if before not in (None, downscale):
            changes[iteration] = downscale
        before = downscale
    return changes


def _series(logs: list[NamedLog], key: str, named: bool = True, dashed: bool = False) -> list[Curve]:
    """One curve for each log, of the records that have an iteration and mention the key."""
    curves = []
    for label, color, records in logs:
        points = [(record.number("iteration"), record.number(key)) for record in records if key in record.values]
        x, y = [x for x, _ in points if x is not None], [y for x, y in points if x is not None]
        curves.append(Curve(label if named else "", color, x, y, dashed))
    return curves


def _states(statuses: list[tuple[str, JsonRecord]], report: ReportedRun) -> Html:
    rows = [
        [name, f"{status.count('iteration')} / {status.count('iterations')}", status.count("anchors"),
         status.format("psnr_training"), report.stage_state(name)]
        for name, status in statuses if status
    ]  # fmt: skip
    return table(["", "iterations", "anchors", "PSNR while training (dB)", "state"], rows, wrap_last_column=True)


def _growth(logs: list[NamedLog]) -> list[Html]:
    """Compensated growth (section IV-C), cycle by cycle."""
    cycles = [
        (name, color, records)
        for name, color, lines in logs
        if (records := [record for record in lines if record.number("low_share") is not None])
    ]
    if not cycles:
        return []
    grown = [*_series(cycles, "grown_low"), *_series(cycles, "grown_other", named=False, dashed=True)]
    limits = _series(cycles, "t_low")
    moving = len({value for curve in limits for value in curve.y}) > 1  # else the table below says it all
    charts = (
        (_series(cycles, "low_share"), "share of anchors of low visibility", "share of low visibility"),
        (limits if moving else [], "T_low: c_k below it is low", "T_low"),
        (_series(cycles, "mean_cache"), "mean gradient added, g", "cache"),
        (grown, "anchors grown: low, dashed the others", "anchors grown"),
    )
    return [
        heading("Compensated growth in the blocks"),
        paragraph(
            "In every growth cycle, anchors that few of the cycle's cameras see (c_k below T_low) get gradients of "
            "past cycles added, so that they may grow too. One dot is one cycle."
        ),
        gallery(
            figure(draw_curves(curves, title, show_markers=True, from_zero=True), "", alt)
            for curves, title, alt in charts
        ),
        _growth_table(cycles),
    ]


def _growth_table(cycles: list[NamedLog]) -> Html:
    rows = []
    for name, _, records in cycles:
        low, other = (sum(record.number(key) or 0 for record in records) for key in ("grown_low", "grown_other"))
        last, share = records[-1], format_percent(low / (low + other) if low + other else None)
        row = [name, count(len(records)), count(low), count(other), share, format_percent(last.number("low_share"))]
        rows.append([*row, last.format("t_low", "{:.3g}"), last.format("mean_cache", "{:.2e}")])
    head = ["", "cycles", "grown, low", "grown, other", "of it low", "low share, last", "T_low, last", "mean g, last"]
    return table(head, rows, "Sums over all cycles, and the last cycle")


def costs_section(report: ReportedRun) -> Html:
    source, rows, counted = report.files(), list[list[str]](), list[JsonRecord]()
    for label, stage, record in _stage_records(source, report.run):
        if record:
            rows.append([label, *_cost(record), report.stage_state(stage)])
            counted += [record] if report.status.of(stage).state != "stale" else []
    if counted:
        seconds = [record.number("seconds") or 0.0 for record in counted]
        peaks = [record.number("peak_memory_bytes") or 0.0 for record in counted]
        rows.append(["sum, highest", duration(sum(seconds)), data_size(max(peaks)), ""])
    costs = table(["stage", "time", "peak memory", "state"], rows, COST_CAPTION)
    absent = paragraph("" if rows else "No stage has run yet.", "absent")
    return section("costs", "Time and memory", [costs, absent], source.notes)


def _cost(record: JsonRecord) -> tuple[str, str]:
    return duration(record.number("seconds")), data_size(record.number("peak_memory_bytes"))


def _stage_records(source: RunFiles, run: RunFolder) -> list[tuple[str, str, JsonRecord]]:
    """Label, stage, and the record that holds its seconds and memory."""
    merged = source.record("merged/status.json").values
    cost_of_merge = {key: merged.get(f"merge_{key}") for key in ("seconds", "peak_memory_bytes")}
    blocks = [(f"block {index}", f"{name}/status.json") for index, name in list_blocks(run)]
    return [
        ("coarse training", "coarse", source.record("coarse/status.json")),
        ("coarse evaluation", "coarse evaluation", source.record("coarse/evaluation/status.json")),
        ("partition and assignment", "cameras", source.record("partition/partition.json")),
        *((name, name, source.record(file)) for name, file in blocks),
        ("merge", "merge", JsonRecord(cost_of_merge if merged else {})),
        ("evaluation", "evaluation", source.record("evaluation/status.json")),
    ]


def settings_section(report: ReportedRun) -> Html:
    source = report.files()
    text = source.text("config.yaml")
    if text is None:
        parts = [paragraph("There is no config.yaml.", "absent")]
    else:
        more = len(text) - MAX_SETTINGS_CHARS
        ending = f"\n… {more} characters more" if more > 0 else ""
        parts = [details("config.yaml", preformatted(text[:MAX_SETTINGS_CHARS] + ending))]
    return section("settings", "Settings", parts, source.notes)
