"""What came out: the summary, test views, quality by visibility, by block and at the seams."""

from __future__ import annotations

from pathlib import PurePosixPath

from vdgs.evaluation.by_visibility import format_bounds
from vdgs.evaluation.comparison_images import unique_file_stems
from vdgs.evaluation.metric_tables import format_angles
from vdgs.report.charts import draw_gain_bars, draw_psnr_bars
from vdgs.report.html_page import Html, details, figure, gallery, paragraph, section, table
from vdgs.report.run_reader import (
    DB,
    SIMILARITY,
    JsonRecord,
    ReportedRun,
    RunFiles,
    format_difference,
    format_percent,
    format_value,
)
from vdgs.system.units import ABSENT, count, data_size

COARSE_EVALUATION, MERGED_EVALUATION = "coarse/evaluation", "evaluation"
#: Rows of the table of test views, and pictures of seams, at most.
MAX_VIEW_ROWS, MAX_SEAM_IMAGES = 400, 3
#: key in metrics.json, label, format
METRICS = (
    ("psnr", "PSNR (dB) ↑", DB),
    ("psnr_cc", "PSNR, color-corrected (dB) ↑", DB),
    ("psnr_reference_exposure", "PSNR in neutral colors (dB) ↑", DB),
    ("ssim", "SSIM ↑", SIMILARITY),
    ("ssim_cc", "SSIM, color-corrected ↑", SIMILARITY),
    ("ssim_reference_exposure", "SSIM in neutral colors ↑", SIMILARITY),
    ("lpips_vgg", "LPIPS vgg ↓", SIMILARITY),
    ("lpips_vgg_cc", "LPIPS vgg, color-corrected ↓", SIMILARITY),
    ("lpips_vgg_01", "LPIPS vgg, [0, 1] input ↓", SIMILARITY),
    ("lpips_vgg_01_cc", "LPIPS vgg, [0, 1] input, color-corrected ↓", SIMILARITY),
    ("opacity_coverage", "share of seen pixels that is opaque ↑", "{:.4f}"),
    ("psnr_covered_own_background", "PSNR of seen pixels on its own background (dB) ↑", DB),
    ("psnr_covered_black", "PSNR of seen pixels on black (dB) ↑", DB),
    ("psnr_covered_white", "PSNR of seen pixels on white (dB) ↑", DB),
    ("depth_error_median_expected", "median error of expected depth (camera heights) ↓", "{:.4f}"),
    ("depth_error_median_median", "median error of median depth (camera heights) ↓", "{:.4f}"),
    ("depth_within_1_percent_expected", "share with expected depth within 1 % ↑", "{:.4f}"),
    ("depth_within_1_percent_median", "share with median depth within 1 % ↑", "{:.4f}"),
    ("depth_within_2_percent_median", "share with median depth within 2 % ↑", "{:.4f}"),
    ("needles", "share of what is drawn by needles ↓", "{:.4f}"),
    ("floaters", "share of pixels with floaters ↓", "{:.4f}"),
    ("oversized_splats", "splats larger than the picture, all test views ↓", "{:,.0f}"),
)


def read_metrics(source: RunFiles) -> tuple[JsonRecord, JsonRecord]:
    """Metrics of the coarse and of the merged model; where nothing is merged yet, a run evaluates its coarse model."""
    coarse, merged = (source.record(f"{folder}/metrics.json") for folder in (COARSE_EVALUATION, MERGED_EVALUATION))
    if merged.text("model") == "coarse":
        return coarse or merged, JsonRecord({})
    return coarse, merged


def _result_summary(coarse: JsonRecord, merged: JsonRecord) -> str:
    """The result in one line."""
    before, after = coarse.number("psnr"), merged.number("psnr")
    if after is None and before is None:
        return "Nothing is evaluated yet."
    if after is None or before is None:
        name, one = ("Coarse", coarse) if after is None else ("Merged", merged)
        return (
            f"{name} model: PSNR {one.format('psnr')} dB (color-corrected {one.format('psnr_cc')}), "
            f"SSIM {one.format('ssim', SIMILARITY)}."
        )
    return (
        f"Coarse → merged: PSNR {format_value(before, DB)} → {format_value(after, DB)} dB "
        f"({format_difference(after, before)}), color-corrected {_change(coarse, merged, 'psnr_cc', DB)} dB; "
        f"SSIM {_change(coarse, merged, 'ssim', SIMILARITY)}."
    )


def _change(coarse: JsonRecord, merged: JsonRecord, key: str, form: str) -> str:
    before, after, difference = _compared(coarse, merged, key, form)
    return f"{before} → {after} ({difference})"


def _compared(coarse: JsonRecord, merged: JsonRecord, key: str, form: str) -> list[str]:
    """A number of both models, and the difference."""
    difference = format_difference(merged.number(key), coarse.number(key), form)
    return [coarse.format(key, form), merged.format(key, form), difference]


def metrics_section(report: ReportedRun) -> Html:
    """Every measure of both models and the difference; measures that neither has are left out."""
    source = report.files()
    coarse, merged = read_metrics(source)

    def is_known(key: str) -> bool:
        return (coarse.number(key), merged.number(key)) != (None, None)

    rows = [[label, *_compared(coarse, merged, key, form)] for key, label, form in METRICS if is_known(key)]
    for key, label, to_text in (
        ("n_anchors", "anchors", count),
        ("model_bytes", "size of the model", data_size),
        ("fps", "images drawn a second", lambda value: format_value(value, "{:.1f}")),
        ("test_views", "test views", count),
    ):
        if is_known(key):
            rows.append([label, to_text(coarse.number(key)), to_text(merged.number(key)), ""])
    notes = dict.fromkeys(merged.texts("notes") + coarse.texts("notes"))
    summary = paragraph(_result_summary(coarse, merged), "verdict")
    parts = [summary, table(["", "coarse", "merged", "Δ"], rows), *(paragraph(note, "facts") for note in notes)]
    return section("metrics", "Metrics", parts, source.notes)


def views_section(report: ReportedRun) -> Html:
    source = report.files()
    files = [f"{folder}/per_view.json" for folder in (MERGED_EVALUATION, COARSE_EVALUATION)]
    folder = MERGED_EVALUATION if source.has(files[0]) else COARSE_EVALUATION
    rows = [row for row in source.rows(f"{folder}/per_view.json") if row.number("psnr") is not None]
    coarse_rows = source.rows(files[1]) if folder == MERGED_EVALUATION else []
    coarse = {row.text("name"): row for row in coarse_rows}
    parts: list[Html] = []
    if not rows and not source.exists(*files):
        parts.append(paragraph("No test view is evaluated yet.", "absent"))
    for kind, row in _best_median_worst(rows):
        parts.append(_comparison(source, folder, kind, row, coarse.get(row.text("name"), JsonRecord({}))))
    parts.append(_least_opaque_view(source, folder, rows))
    sheet = source.image(f"{folder}/contact_sheet.png")
    parts.append(figure(sheet, "All test views (or an even choice of them).", "contact sheet of the test views", True))
    parts.append(details(f"All {len(rows)} test views in numbers", _views_table(rows, coarse)))
    return section("views", "Test views", parts, source.notes)


def _best_median_worst(rows: list[JsonRecord]) -> list[tuple[str, JsonRecord]]:
    """By PSNR; fewer where there are fewer than three views."""
    ranked = sorted(rows, key=lambda row: row.number("psnr") or 0.0)
    if not ranked:
        return []
    chosen = {len(ranked) - 1: "Best", (len(ranked) - 1) // 2: "Median", 0: "Worst"}
    return [(kind, ranked[rank]) for rank, kind in sorted(chosen.items(), reverse=True)]


def _comparison(source: RunFiles, folder: str, kind: str, row: JsonRecord, coarse: JsonRecord) -> Html:
    name, stem = row.text("name") or "unnamed", PurePosixPath(row.text("render") or "").stem
    caption = f"{kind}: {name}, {row.format('psnr')} dB, SSIM {row.format('ssim', SIMILARITY)}"
    if coarse.number("psnr") is not None:
        caption += f" (coarse {coarse.format('psnr')} dB)"
    if row.number("mean_visibility") is not None:
        caption += f", mean V {row.format('mean_visibility', '{:.1f}')}"
    image = source.image(f"{folder}/comparisons/{stem}.png") if stem else None
    if image is None:
        return paragraph(f"{caption}. Its picture is not there.", "absent")
    return figure(image, f"{caption}.", f"photograph, render and error of {name}", True)


def _least_opaque_view(source: RunFiles, folder: str, rows: list[JsonRecord]) -> Html:
    """Alpha of the view with the lowest share of opaque pixels: where ground is half transparent, it is gray."""
    known = [
        (solid, row) for row in rows if (solid := row.number("opacity_coverage")) is not None and row.text("alpha")
    ]
    if not known:
        return Html("")
    solid, row = min(known, key=lambda each: each[0])
    name, stem = row.text("name") or "unnamed", PurePosixPath(row.text("alpha") or "").stem
    caption = (
        f"Least solid: alpha of {name}, white is opaque. Of its pixels that at least 3 training cameras see, "
        f"{format_percent(solid)} have alpha of at least 0.95."
    )
    return figure(source.image(f"{folder}/alpha/{stem}.png"), caption, f"alpha of {name}")


def _views_table(rows: list[JsonRecord], coarse: dict[str | None, JsonRecord]) -> Html:
    lines = []
    for row in rows[:MAX_VIEW_ROWS]:
        psnrs = _compared(coarse.get(row.text("name"), JsonRecord({})), row, "psnr", DB)
        similarities = [row.format("ssim", SIMILARITY), row.format("lpips_vgg", SIMILARITY)]
        opaque = [format_percent(row.number("opacity_coverage")), row.count("oversized_splats")]
        name = row.text("name") or ABSENT
        lines.append([name, row.format("mean_visibility"), *psnrs, row.format("psnr_cc"), *similarities, *opaque])
    head = [
        "view", "mean V", "PSNR coarse", "PSNR", "Δ",
        "PSNR corrected", "SSIM", "LPIPS vgg", "solid", "large splats",
    ]  # fmt: skip
    caption = f"The first {MAX_VIEW_ROWS} of {len(rows)}" if len(rows) > MAX_VIEW_ROWS else ""
    return table(head, lines, caption)


def by_visibility_section(report: ReportedRun) -> Html:
    source = report.files()
    coarse, merged = read_metrics(source)
    bins = merged.rows("by_visibility") or coarse.rows("by_visibility")
    coarse_bins = {_bounds(row): row for row in coarse.rows("by_visibility")}
    pairs = [(coarse_bins.get(_bounds(row), JsonRecord({})), row if merged else JsonRecord({})) for row in bins]
    before, after = [one.number("psnr") for one, _ in pairs], [other.number("psnr") for _, other in pairs]
    gains = [None if a is None or b is None else a - b for b, a in zip(before, after, strict=True)]
    labels = [_bounds(row).replace(" to ", "–").replace(" ", "\n") for row in bins]
    charts = [
        figure(draw_psnr_bars(labels, before, after), "", "PSNR by visibility"),
        figure(draw_gain_bars(labels, gains), "", "gain of PSNR by visibility"),
    ]
    parts = [
        paragraph("Pixels of all test views, by the number V of training photographs that see the place drawn."),
        paragraph("" if bins else "There are no figures by visibility yet.", "absent"),
        _bins_table(bins, pairs),
        gallery(charts),
    ]
    return section("by-visibility", "Quality by visibility", parts, source.notes)


def _bounds(row: JsonRecord) -> str:
    lower, upper = row.number("lower"), row.number("upper")
    return "nothing drawn" if lower is None or upper is None else format_bounds(lower, upper)


def _bins_table(bins: list[JsonRecord], pairs: list[tuple[JsonRecord, JsonRecord]]) -> Html:
    rows = []
    for row, (coarse, merged) in zip(bins, pairs, strict=True):
        psnr, psnr_cc = (_compared(coarse, merged, key, DB) for key in ("psnr", "psnr_cc"))
        rows.append(
            [_bounds(row), row.count("pixels"), *psnr, *psnr_cc, *_compared(coarse, merged, "ssim", SIMILARITY)]
        )
    head = [
        "V", "pixels", "PSNR coarse", "merged", "Δ", "PSNR corrected coarse",
        "merged", "Δ", "SSIM coarse", "merged", "Δ",
    ]  # fmt: skip
    return table(head, rows)


def off_path_section(report: ReportedRun) -> Html:
    """Views from where nobody flew; empty where the capture has none."""
    source = report.files()
    before, after = (
        record
        if (record := source.record(f"{folder}_off_path/metrics.json")).text("key") == tested.text("key")
        else JsonRecord({})
        for folder, tested in zip((COARSE_EVALUATION, MERGED_EVALUATION), read_metrics(source), strict=True)
    )
    shown, folder = (after, MERGED_EVALUATION) if after else (before, COARSE_EVALUATION)
    if not shown:
        return Html("")
    rows = []
    for name in shown.child("sets").values:
        one, other = before.child("sets").child(name), after.child("sets").child(name)
        rows.append([name, shown.child("sets").child(name).count("views"), *_off_path_cells(one, other)])
    angles = [
        [format_angles(row.number("lower") or 0.0, row.number("upper")), row.count("pixels"), row.format("psnr"),
         format_percent(row.number("depth_within_2_percent"))]
        for row in shown.rows("by_angle")
    ]  # fmt: skip
    head = ["kind", "views", *(f"{what} {of}" for what in ("PSNR", "depth within 2 %", "needles", "floaters")
                               for of in ("coarse", "merged"))]  # fmt: skip
    sheet = source.image(f"{folder}_off_path/contact_sheet.png")
    parts = [
        paragraph("Views from where nobody flew. Quality and depth: of pixels that at least 3 training cameras see; "
                  "depth within 2 % of the camera height. Needles: share of what is drawn by splats seen as lines. "
                  "Floaters: share of pixels that show something before the true surface."),
        table(head, rows),
        table(["angle to the nearest training view", "pixels", "PSNR", "depth within 2 %"], angles),
        figure(sheet, "Photograph and render of each off-path view.", "contact sheet of the off-path views", True),
    ]  # fmt: skip
    return section("off-path", "Off the path of the flight", parts, source.notes)


def _off_path_cells(coarse: JsonRecord, merged: JsonRecord) -> list[str]:
    cells = [one.format("psnr") for one in (coarse, merged)]
    for key in ("depth_within_2_percent_median", "needles", "floaters"):
        cells += [format_percent(one.number(key)) for one in (coarse, merged)]
    return cells


def seams_section(report: ReportedRun) -> Html:
    if report.is_one_block:
        return Html("")
    source, file = report.files(), f"{MERGED_EVALUATION}/by_block.json"
    metrics = source.record(file)
    is_absent = not metrics and not source.exists(file)
    rows = [_block_row(row.count("block"), row) for row in metrics.rows("blocks")]
    if rows and metrics.child("all"):
        rows.append(_block_row("all", metrics.child("all")))
    head = ["block", "pixels", "PSNR coarse", "PSNR isolated", "PSNR merged", "merged − coarse"]
    caption = (
        "PSNR pooled over the pixels of test views that show a block (not a mean over views). "
        "Isolated: the block as trained, before the merge"
    )
    absent = "There are no figures by block: fewer than two blocks are merged." if is_absent else ""
    parts = [
        paragraph(absent, "absent"),
        table(head, rows, caption),
        paragraph(_seam_sentence(metrics.child("seams"))),
        *_seam_images(source, metrics.rows("views")),
    ]
    return section("seams", "Per block, and the seams between blocks", parts, source.notes)


def _block_row(name: str, row: JsonRecord) -> list[str]:
    psnrs = [row.format(f"psnr_{key}") for key in ("coarse", "isolated", "merged")]
    return [name, row.count("pixels"), *psnrs, format_difference(row.number("psnr_merged"), row.number("psnr_coarse"))]


def _seam_sentence(seams: JsonRecord) -> str:
    if seams.number("seam_mae_ratio") is None:
        return ""
    return (
        f"Within {seams.format('border_px', '{:g}')} px of a border between blocks ({seams.count('border_pixels')} "
        f"pixels), the error relative to elsewhere is {seams.format('seam_mae_ratio')} times what it is in the coarse "
        f"model, which has no seams (mean absolute error; squared error {seams.format('seam_mse_ratio')}). 1 is no "
        "seam; above 1, borders got worse."
    )


def _seam_images(source: RunFiles, views: list[JsonRecord]) -> list[Html]:
    """The views in which most pixels lie near a border."""
    names = [row.text("name") or "" for row in views]
    files = [f"{MERGED_EVALUATION}/seams/{stem}.png" for stem in unique_file_stems(names)]
    near = [row.number("border_pixels") or 0.0 for row in views]
    ranked = sorted(
        (-pixels, name, file) for pixels, name, file in zip(near, names, files, strict=True) if source.has(file)
    )
    return [
        figure(source.image(file), f"{name}: the model before and after the merge.", f"seams in {name}", True)
        for _, name, file in ranked[:MAX_SEAM_IMAGES]
    ]
