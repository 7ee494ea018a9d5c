"""The place: who sees what, how it was cut into blocks, which photographs each block was given."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from vdgs.report.formatting import format_percent, format_value
from vdgs.report.html_page import Html, figure, heading, link, paragraph, section, table
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles
from vdgs.system.units import ABSENT, count


def html_export_link(report: ReportedRun) -> Html:
    """The page to move through the scene with, where `vdgs export` wrote one of the model that the run has now."""
    run = report.run
    record = RunFiles(run.path).record("export.json")  # its own section tells of other files that cannot be read
    stage = run.merged if record.text("model") == "merged" else run.coarse
    if record.text("key") is None or record.text("key") != stage.key():
        return Html("")
    for file in record.rows("files"):
        path = file.text("file") or ""
        if path.lower().endswith(".html") and os.path.isfile(path):
            address = quote(Path(os.path.relpath(path, run.path.resolve())).as_posix())
            size = (file.number("bytes") or 0) / 1e6
            return link(
                address, "Move through the scene", f" ({os.path.basename(path)}, {size:,.1f} MB; opens offline)"
            )
    return Html("")


def visibility_section(report: ReportedRun) -> Html:
    source = report.files()
    facts = source.record("visibility/visibility.json")
    parts = [
        paragraph(
            "V is the number of training photographs that see a place. Where it is low, a model has little to go by; "
            "the blocks are cut and trained with V in mind."
        )
    ]
    if facts:
        parts.append(paragraph(_visibility_sentence(facts)))
        parts.append(_distribution(facts))
    elif not source.exists("visibility/visibility.json"):
        parts.append(paragraph("Visibility is not measured yet.", "absent"))
    parts.append(
        figure(source.image("visibility/map.png"), "The place from above, coloured by V.", "map of visibility", True)
    )
    if facts and not source.has("visibility/map.png"):
        parts.append(paragraph("There is no map of it (visibility/map.png).", "absent"))
    return section("visibility", "The place and its visibility", parts, source.notes)


def blocks_section(report: ReportedRun) -> Html:
    source = report.files()
    facts = source.record("partition/partition.json")
    parts: list[Html] = []
    if not facts and not source.exists("partition/partition.json"):
        parts.append(paragraph("The scene is not cut into blocks yet.", "absent"))
    rows = facts.rows("blocks")
    if rows:
        how = facts.number("lambda_vis")
        parts.append(
            paragraph(
                f"{len(rows)} block{'s' if len(rows) > 1 else ''}"
                + (f", cut by place and visibility (λ_vis = {how:g})." if how is not None else ".")
                + " The core belongs to one block; the widened block reaches over its borders."
            )
        )
    parts += [paragraph(note, "note") for note in facts.texts("warnings") + facts.texts("assignment_warnings")]
    parts.append(figure(source.image("partition/blocks.png"), "The blocks from above.", "map of the blocks", True))
    parts.append(_blocks_table(rows, facts.rows("spatial_only_blocks")))
    parts.append(
        figure(source.image("partition/block_facts.png"), "What each block holds.", "sizes of the blocks", True)
    )
    missing = [name for name in ("blocks.png", "block_facts.png") if facts and not source.has(f"partition/{name}")]
    if missing:
        parts.append(paragraph(f"Figures that are not there: {', '.join(missing)}.", "absent"))
    return section("blocks", "Blocks", parts, source.notes)


def assignment_section(report: ReportedRun) -> Html:
    source = report.files()
    facts = source.record("partition/partition.json")
    rows = facts.rows("blocks")
    parts: list[Html] = []
    if rows:
        parts.append(
            paragraph(
                "A photograph trains every block to whose image it contributes more than the threshold; each trains at "
                "least the block it serves best, and blocks with too few photographs are topped up with the next best."
            )
        )
        parts.append(_cameras_table(rows))
    else:
        parts.append(paragraph("No photographs are assigned to blocks yet.", "absent"))
    scores = source.image("partition/scores.png")
    parts.append(
        figure(scores, "Score of every photograph (row) for every block (column).", "matrix of scores", tall=True)
    )
    if rows and not source.has("partition/scores.png"):
        parts.append(paragraph("There is no figure of the scores (partition/scores.png).", "absent"))
    return section("cameras", "Camera assignment", parts, source.notes)


def _visibility_sentence(record: JsonRecord) -> str:
    quantiles, below = record.child("quantiles"), record.child("share_below")
    parts = []
    if record.number("anchors") is not None:
        parts.append(f"{count(record.number('anchors'))} anchors, {count(record.number('training_views'))} photographs")
    if quantiles.number("50") is not None:
        parts.append(f"the median anchor is seen by {quantiles.number('50'):g}")
    if below.number("3") is not None:
        parts.append(f"{format_percent(below.number('3'))} of the anchors by fewer than 3")
    return "; ".join(parts) + "." if parts else ""


def _distribution(record: JsonRecord) -> Html:
    quantiles, below = record.child("quantiles"), record.child("share_below")
    head = ["mean V", "Gini"]
    row = [format_value(record.number("mean"), "{:.2f}"), format_value(record.number("gini"), "{:.3f}")]
    for percent in [key for key in quantiles.values if key.isdecimal()][:9]:
        head.append(f"{percent} %")
        row.append(format_value(quantiles.number(percent), "{:g}"))
    for limit in [key for key in below.values if key.isdecimal()][:9]:
        head.append(f"V < {limit}")
        row.append(format_percent(below.number(limit)))
    return table(head, [row], "V over all anchors: mean, inequality, quantiles, share below a limit")


def _blocks_table(rows: list[JsonRecord], spatial: list[JsonRecord]) -> Html:
    spread = {row.number("block"): row.number("std_v") for row in rows}
    head = ["block", "anchors of the core", "widened", "area of the core", "mean V", "cameras"]
    if any(value is not None for value in spread.values()):
        head.append("std V")
    lines = []
    for row in rows:
        line = [
            count(row.number("block")), count(row.number("anchors_core")), count(row.number("anchors_expanded")),
            format_value(row.number("area"), "{:,.0f}"), format_value(row.number("mean_v"), "{:.2f}"),
            count(row.number("cameras")),
        ]  # fmt: skip
        if "std V" in head:
            line.append(format_value(row.number("std_v"), "{:.2f}"))
        lines.append(line)
    ours = table(head, lines, "Areas are in square units of the ground frame (m² where the capture is metric)")
    if not spatial:
        return ours
    theirs = [
        [
            count(row.number("block")), count(row.number("anchors_core")), format_value(row.number("area"), "{:,.0f}"),
            format_value(row.number("mean_v"), "{:.2f}"), format_value(row.number("std_v"), "{:.2f}"),
        ]
        for row in spatial
    ]  # fmt: skip
    compared = table(["block", "anchors of the core", "area of the core", "mean V", "std V"], theirs)
    return Html(ours + "\n" + heading("For comparison: cut by place alone (λ_vis = 0)") + "\n" + compared)


def _cameras_table(rows: list[JsonRecord]) -> Html:
    keys = ("cameras", "above_threshold", "best_block", "topped_up")
    lines = [[count(row.number("block")), *(count(row.number(key)) for key in keys)] for row in rows]
    totals = [_total(rows, key) for key in keys]
    if len(rows) > 1 and ABSENT not in totals:
        lines.append(["all", *totals])
    return table(["block", "cameras", "above the threshold", "their best block", "topped up"], lines)


def _total(rows: list[JsonRecord], key: str) -> str:
    values = [row.number(key) for row in rows]
    known = [value for value in values if value is not None]
    return count(sum(known)) if len(known) == len(values) else ABSENT


def ortho_section(report: ReportedRun) -> Html:
    """The sheet of `vdgs ortho`, of the merged model that is there."""
    source = report.files()
    facts = source.record("maps/map.json")
    parts: list[Html] = []
    if not facts:
        parts.append(paragraph("No maps were made of this run. `vdgs ortho RUN` makes them."))
    elif facts.text("model_digest") != report.run.merged.status().model_id:
        parts.append(
            paragraph("The maps are of another model than the run has now; `vdgs ortho RUN` draws them anew.", "note")
        )
    else:
        gsd, unit = facts.number("gsd"), facts.text("unit")
        parts.append(
            paragraph(
                f"Orthophoto, surface model and visibility in {facts.text('crs_name')}"
                + (f", pixels of {gsd:.3g} {unit}" if gsd else "")
                + ": GeoTIFFs in maps/. Blank is what is not solid, or what no training photograph shows."
            )
        )
        parts.append(figure(source.image("maps/preview.png"), "The scene as maps.", "maps of the scene", True))
    return section("maps", "Maps", parts, source.notes)
