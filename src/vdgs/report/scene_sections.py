"""The place: how it was photographed, who sees what, how it was cut into blocks, which photographs each block has."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from vdgs.captures.reconstruction import (
    RECONSTRUCTION_FIGURE,
    RECONSTRUCTION_FILE,
    ReconstructionReport,
    excluded_lines,
    gcp_table,
    report_rows,
)
from vdgs.report.html_page import Html, details, figure, heading, join_html, link, paragraph, section, table
from vdgs.report.place_section import MAP_FILE, current_map, levels_of
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles, format_percent
from vdgs.runs.run_folder import MOTION_EXAMPLES, MOTION_FILE
from vdgs.system.records import record_from_dict
from vdgs.system.units import ABSENT, count, format_length

#: Photographs left out that are named.
MAX_LISTED = 500
VISIBILITY_FILE, PARTITION_FILE = "visibility/visibility.json", "partition/partition.json"


def html_export_link(report: ReportedRun) -> Html:
    """The page to move through the scene with, where `vdgs export` wrote one of the whole model that the run has now.

    The page that was written last, where there are several; none that another file has replaced since, such as the page
    of another run.
    """
    root, model_id = report.run.path.resolve(), _model_id(report)
    record = RunFiles(report.run.path).record("export.json")  # its own section tells of other files that cannot be read
    for file in record.rows("files"):
        page = root / (file.text("file") or "")  # of the run, or an absolute path
        is_whole = not {"block", "bbox"} & {key for key, value in file.values.items() if value is not None}
        if model_id is None or file.text("model_id") != model_id or not is_whole or page.suffix.lower() != ".html":
            continue
        if os.path.isfile(page) and page.stat().st_size == file.number("bytes"):
            address = quote(Path(os.path.relpath(page, root)).as_posix())
            fewest = file.number("min_visibility") or 0
            edge = f"; without what fewer than {fewest:.0f} photographs show" if fewest else ""
            note = f" ({page.name}, {page.stat().st_size / 1e6:,.1f} MB; opens offline{edge})"
            return link(address, "Move through the scene", note)
    return Html("")


def _model_id(report: ReportedRun) -> str | None:
    """The identity of the model that the run has now: the merged one or, where there is none, the coarse one. None
    where neither is finished, for the settings of the run as far as that can be told."""
    for stage in map(report.status.of, ("merge", "coarse")):
        is_finished = stage.status is not None and stage.status.state == "done"
        if is_finished and stage.state in ("done", "unknown") and stage.output_id:
            return stage.output_id
    return None


def sfm_section(report: ReportedRun) -> Html:
    """How the capture was made of photographs; nothing where the capture came from elsewhere."""
    source, title = report.files(), "From photographs to cameras"
    written = source.record(RECONSTRUCTION_FILE)
    if not written and not source.notes:
        return Html("")
    try:
        reconstruction = record_from_dict(ReconstructionReport, written.values)
    except ValueError as error:
        source.notes.append(f"{RECONSTRUCTION_FILE} is damaged ({error}); what it says is left out.")
        return section("photographs", title, [], source.notes)
    parts = [table(["what", "how much"], report_rows(reconstruction), wrap_last_column=True)]
    parts += [paragraph(warning, "note") for warning in reconstruction.warnings]
    if reconstruction.survey:
        names = ["point", "used as", "photographs", "east [m]", "north [m]", "up [m]", "error [px]"]
        parts += [heading("Surveyed points: seen minus surveyed"), table(names, gcp_table(reconstruction))]
    caption = "The points from above; arrows lead from the recorded position of a photograph to where it was placed."
    parts.append(figure(source.image(RECONSTRUCTION_FIGURE), caption, "residuals of the positions from above", True))
    parts.append(_excluded_images(excluded_lines(reconstruction)))
    if reconstruction.advice:
        parts += [heading("For the next flight"), *map(paragraph, reconstruction.advice)]
    return section("photographs", title, parts, source.notes)


def _excluded_images(lines: list[str]) -> Html:
    more = len(lines) - MAX_LISTED
    shown = [*lines[:MAX_LISTED], *([f"and {more} more"] if more > 0 else [])]
    title = f"{len(lines)} photograph{'s' if len(lines) != 1 else ''} left out, and why"
    return details(title, join_html(map(paragraph, shown)))


def visibility_section(report: ReportedRun) -> Html:
    source, map_file = report.files(), "visibility/map.png"
    stats = source.record(VISIBILITY_FILE)
    is_absent = not stats and not source.exists(VISIBILITY_FILE)
    parts = [
        paragraph(
            "V is the number of training photographs that see a place. Where it is low, a model has little to go by"
            + ("." if report.is_one_block else "; the blocks are cut and trained with V in mind.")
        ),
        *((paragraph(_visibility_sentence(stats)), _distribution(stats)) if stats else ()),
        paragraph("Visibility is not measured yet." if is_absent else "", "absent"),
        figure(source.image(map_file), "The place from above, colored by V.", "map of visibility", True),
    ]
    if stats and not source.has(map_file):
        parts.append(paragraph(f"There is no map of it ({map_file}).", "absent"))
    return section("visibility", "The place and its visibility", parts, source.notes)


def motion_section(report: ReportedRun) -> Html:
    """What was found to move; nothing of a run whose blocks leave nothing out."""
    source = report.files()
    record = source.record(MOTION_FILE)
    rows = record.rows("photographs") if record else []
    if not rows:
        return Html("")
    masked = sum(row.text("mask") is not None for row in rows)
    text = (
        f"{format_percent(record.number('share'))} of the training photographs moves, in {masked} of {len(rows)}: it "
        "shows there what other photographs of the same place do not show. The blocks leave it out of training; "
        "test views are measured whole."
    )
    caption = "The photographs of which most moves; what their masks leave out is red."
    parts = [paragraph(text), figure(source.image(MOTION_EXAMPLES), caption, "masks of what moves", True)]
    return section("motion", "What moves", parts, source.notes)


def blocks_section(report: ReportedRun) -> Html:
    """How the scene was cut; nothing of a single block."""
    if report.is_one_block:
        return Html("")
    source = report.files()
    partition = source.record(PARTITION_FILE)
    is_absent = not partition and not source.exists(PARTITION_FILE)
    parts = [paragraph("The scene is not cut into blocks yet." if is_absent else "", "absent")]
    rows = partition.rows("blocks")
    if rows:
        how = partition.number("lambda_vis")
        cut = f", cut by place and visibility (λ_vis = {how:g})" if how is not None else ""
        reach = "The core belongs to one block; the widened block reaches over its borders."
        parts.append(paragraph(f"{len(rows)} blocks{cut}. {reach}"))
    is_metric = source.record("capture.json").child("ground_frame").values.get("metric") is True
    area_unit = "m²" if is_metric else "square units of the scene, whose size is not known"
    warnings = partition.texts("warnings") + partition.texts("assignment_warnings")
    missing = [name for name in ("blocks.png", "block_facts.png") if partition and not source.has(f"partition/{name}")]
    parts += [
        *(paragraph(warning, "note") for warning in warnings),
        figure(source.image("partition/blocks.png"), "The blocks from above.", "map of the blocks", True),
        _blocks_table(rows, partition.rows("spatial_only_blocks"), area_unit),
        figure(source.image("partition/block_facts.png"), "What each block holds.", "sizes of the blocks", True),
        paragraph(f"Figures that are not there: {', '.join(missing)}." if missing else "", "absent"),
    ]
    return section("blocks", "Blocks", parts, source.notes)


def assignment_section(report: ReportedRun) -> Html:
    """Which photographs each block has; nothing of a single block."""
    if report.is_one_block:
        return Html("")
    source, score_file = report.files(), "partition/scores.png"
    rows = source.record(PARTITION_FILE).rows("blocks")
    rule = (
        "A photograph trains every block to whose image it contributes more than the threshold; each trains at "
        "least the block it serves best, and blocks with too few photographs are topped up with the next best."
    )
    absent = f"There is no figure of the scores ({score_file})." if rows and not source.has(score_file) else ""
    caption = "Score of every photograph (row) for every block (column)."
    parts = [
        paragraph(rule) if rows else paragraph("No photographs are assigned to blocks yet.", "absent"),
        _cameras_table(rows),
        figure(source.image(score_file), caption, "matrix of scores", tall=True),
        paragraph(absent, "absent"),
    ]
    return section("cameras", "Camera assignment", parts, source.notes)


def _visibility_sentence(record: JsonRecord) -> str:
    quantiles, below = record.child("quantiles"), record.child("fraction_below")
    parts = []
    if record.number("anchors") is not None:
        parts.append(f"{record.count('anchors')} anchors, {record.count('training_views')} photographs")
    if quantiles.number("50") is not None:
        parts.append(f"the median anchor is seen by {quantiles.format('50', '{:g}')}")
    if below.number("3") is not None:
        parts.append(f"{format_percent(below.number('3'))} of the anchors by fewer than 3")
    return "; ".join(parts) + "." if parts else ""


def _distribution(record: JsonRecord) -> Html:
    quantiles, below = record.child("quantiles"), record.child("fraction_below")
    percents, limits = ([key for key in each.values if key.isdecimal()][:9] for each in (quantiles, below))
    head = ["mean V", "Gini", *(f"{percent} %" for percent in percents), *(f"V < {limit}" for limit in limits)]
    row = [record.format("mean"), record.format("gini", "{:.3f}")]
    row += [quantiles.format(percent, "{:g}") for percent in percents]
    row += [format_percent(below.number(limit)) for limit in limits]
    return table(head, [row], "V over all anchors: mean, inequality, quantiles, share below a limit")


def _blocks_table(rows: list[JsonRecord], spatial: list[JsonRecord], area_unit: str) -> Html:
    head = ["block", "anchors of the core", "widened", "area of the core", "mean V", "cameras"]
    has_std = any(row.number("std_v") is not None for row in rows)
    lines = []
    for row in rows:
        anchors = [row.count("anchors_core"), row.count("anchors_expanded")]
        line = [row.count("block"), *anchors, row.format("area", "{:,.0f}"), row.format("mean_v"), row.count("cameras")]
        lines.append([*line, *([row.format("std_v")] if has_std else [])])
    caption = f"Areas are in {area_unit}"
    blocks_table = table([*head, *(["std V"] if has_std else [])], lines, caption)
    if not spatial:
        return blocks_table
    spatial_lines = [
        [row.count("block"), row.count("anchors_core"), row.format("area", "{:,.0f}"), row.format("mean_v"),
         row.format("std_v")]
        for row in spatial
    ]  # fmt: skip
    compared = table(["block", "anchors of the core", "area of the core", "mean V", "std V"], spatial_lines)
    return Html(f"{blocks_table}\n{heading('For comparison: cut by place alone (λ_vis = 0)')}\n{compared}")


def _cameras_table(rows: list[JsonRecord]) -> Html:
    keys = ("cameras", "above_threshold", "best_block", "topped_up")
    lines = [[row.count("block"), *map(row.count, keys)] for row in rows]
    totals = [_total(rows, key) for key in keys]
    if len(rows) > 1 and ABSENT not in totals:
        lines.append(["all", *totals])
    return table(["block", "cameras", "above the threshold", "their best block", "topped up"], lines)


def _total(rows: list[JsonRecord], key: str) -> str:
    known = [value for row in rows if (value := row.number(key)) is not None]
    return count(sum(known)) if len(known) == len(rows) else ABSENT


def ortho_section(report: ReportedRun) -> Html:
    """The sheet of `vdgs ortho`, of the merged model that is there."""
    source = report.files()
    metadata = current_map(report, source)
    if not metadata:
        stale = "The maps are of another model than the run has now; `vdgs ortho RUN` draws them anew."
        none = "No maps were made of this run. `vdgs ortho RUN` makes them."
        is_stale = source.exists(MAP_FILE) and not source.notes
        parts = [paragraph(stale, "note") if is_stale else paragraph(none)]
    else:
        gsd, unit = metadata.number("gsd"), metadata.text("unit") or "units"
        parts = [
            paragraph(
                f"Orthophoto, surface model and visibility in {metadata.text('crs_name')}"
                + (f", pixels of {format_length(gsd, unit)}" if gsd else "")
                + f"{levels_of(metadata)}: GeoTIFFs in maps/. Blank is what is not solid, or what no training "
                "photograph shows."
            ),
            *(paragraph(note, "note") for note in metadata.texts("notes")),
            figure(source.image("maps/preview.png"), "The scene as maps.", "maps of the scene", True),
        ]
    return section("maps", "Maps", parts, source.notes)
