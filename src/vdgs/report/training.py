"""How training went: curves of the coarse model and of the blocks, and what compensated growth did."""

from __future__ import annotations

from vdgs.partition.figure_words import block_colour
from vdgs.report.charts import MERGED, Curve, draw_curves
from vdgs.report.page import Html, figure, gallery, heading, paragraph, section, table
from vdgs.report.reading import Record, Source
from vdgs.report.words import count, decibels, figure_of, share
from vdgs.run import RunFolder

#: Log lines over which the loss is smoothed: it is that of a single photograph.
SMOOTH = 9

#: A name, its colour and its log.
Log = tuple[str, str, list[Record]]


def block_names(run: RunFolder) -> list[str]:
    """The folders of blocks, as blocks/NN."""
    return [f"blocks/{folder.path.name}" for folder in run.block_folders() if folder.path.name.isdecimal()]


def training_section(run: RunFolder) -> Html:
    source = Source(run.path)
    parts = [heading("Coarse model")]
    coarse = source.lines("coarse/log.jsonl")
    parts.append(_curves([("coarse", MERGED, coarse)]))
    if not coarse:
        parts.append(paragraph("The coarse model has no log yet.", "absent"))
    parts.append(heading("Blocks"))
    names = block_names(run)
    logs = [
        (f"block {int(name[7:])}", block_colour(int(name[7:])), source.lines(f"{name}/log.jsonl")) for name in names
    ]
    statuses = [source.record(f"{name}/status.json") for name in names]
    parts.append(_curves(logs))
    if not any(records for _, _, records in logs):
        parts.append(paragraph("No block has a log yet.", "absent"))
    parts.append(_states([("coarse", source.record("coarse/status.json")), *_named(logs, statuses)]))
    parts += _growth(logs)
    return section("training", "Training", parts, source.notes)


def _named(logs: list[Log], statuses: list[Record]) -> list[tuple[str, Record]]:
    return [(name, status) for (name, _, _), status in zip(logs, statuses, strict=True)]


def _curves(logs: list[Log]) -> Html:
    psnr = draw_curves(_series(logs, "psnr_smoothed"), "training PSNR, smoothed (dB)")
    anchors = draw_curves(_series(logs, "anchors"), "anchors", from_zero=True)
    loss = draw_curves(_series(logs, "loss"), f"loss (bold: median of {SMOOTH} log lines)", smooth=SMOOTH)
    return gallery([figure(psnr, "", "PSNR"), figure(anchors, "", "anchors"), figure(loss, "", "loss")])


def _series(logs: list[Log], key: str, name: str = "", dashed: bool = False) -> list[Curve]:
    """One curve for each log, of the records that have an iteration and mention the key."""
    curves = []
    for label, colour, records in logs:
        points = [
            (at, record.number(key))
            for record in records
            if key in record.values and (at := record.number("iteration")) is not None
        ]
        curves.append(Curve(label + name, colour, [at for at, _ in points], [value for _, value in points], dashed))
    return curves


def _states(statuses: list[tuple[str, Record]]) -> Html:
    rows = []
    for name, status in statuses:
        if not status:
            continue
        done, wanted = status.number("iteration"), status.number("iterations")
        state = (status.text("state") or "") + (f": {why}" if (why := status.text("why")) else "")
        rows.append(
            [name, f"{count(done)} / {count(wanted)}", count(status.number("anchors")),
             decibels(status.number("psnr_training")), state]
        )  # fmt: skip
    return table(["", "iterations", "anchors", "training PSNR (dB)", "state"], rows, wordy=True)


def _growth(logs: list[Log]) -> list[Html]:
    """Compensated growth (section III-C), cycle by cycle."""
    cycles = [
        (name, colour, found)
        for name, colour, records in logs
        if (found := [record for record in records if record.number("low_share") is not None])
    ]
    if not cycles:
        return []
    # Where there are many blocks, the two curves each would hide one another; the table below has the sums.
    grown = [*_series(cycles, "grown_low", ", low"), *_series(cycles, "grown_other", ", other", dashed=True)]
    charts = (
        (draw_curves(_series(cycles, "low_share"), "share of anchors of low visibility", dots=True, from_zero=True),
         "share of low visibility"),
        (draw_curves(_series(cycles, "t_low"), "T_low: c_k at or below it is low", dots=True, from_zero=True), "T_low"),
        (draw_curves(_series(cycles, "mean_cache"), "mean gradient added, g", dots=True, from_zero=True), "cache"),
        (draw_curves(grown, "anchors grown (dashed: other)", dots=True, from_zero=True), "anchors grown"),
    )  # fmt: skip
    return [
        heading("Compensated growth in the blocks"),
        paragraph(
            "In every growth cycle, anchors that few of the cycle's cameras see (c_k below T_low) get gradients of "
            "past cycles added, so that they may grow too. One dot is one cycle."
        ),
        gallery(figure(chart, "", alt) for chart, alt in charts),
        _growth_table(cycles),
    ]


def _growth_table(cycles: list[Log]) -> Html:
    rows = []
    for name, _, records in cycles:
        low, other = (sum(record.number(key) or 0 for record in records) for key in ("grown_low", "grown_other"))
        last = records[-1]
        rows.append(
            [name, count(len(records)), count(low), count(other), share(low / (low + other)) if low + other else "–",
             share(last.number("low_share")), figure_of(last.number("t_low"), "{:.3g}"),
             figure_of(last.number("mean_cache"), "{:.2e}")]
        )  # fmt: skip
    head = ["", "cycles", "grown, low", "grown, other", "of it low", "low share, last", "T_low, last", "mean g, last"]
    return table(head, rows, "Sums over all cycles, and the last cycle")
