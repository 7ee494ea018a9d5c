"""What came out: the verdict, test views, quality by visibility, by block and at the seams."""

from __future__ import annotations

from pathlib import PurePosixPath

from vdgs.evaluation.by_visibility import format_bounds
from vdgs.evaluation.image_io import unique_file_stems
from vdgs.report.charts import draw_gain_bars, draw_psnr_bars
from vdgs.report.formatting import format_db, format_difference, format_percent, format_similarity, format_value
from vdgs.report.html_page import Html, details, figure, gallery, paragraph, section, table
from vdgs.report.run_reader import JsonRecord, ReportedRun, RunFiles
from vdgs.system.units import ABSENT, count, data_size

COARSE_EVALUATION, MERGED_EVALUATION = "coarse/evaluation", "evaluation"
#: Rows of the table of test views, and pictures of seams, at most.
MAX_VIEW_ROWS, MAX_SEAM_IMAGES = 400, 3
#: key in metrics.json, what people call it, format of a value and of a difference
METRICS = (
    ("psnr", "PSNR (dB) ↑", "{:.2f}", "{:+.2f}"),
    ("psnr_cc", "PSNR, colour-corrected (dB) ↑", "{:.2f}", "{:+.2f}"),
    ("psnr_reference_exposure", "PSNR in neutral colours (dB) ↑", "{:.2f}", "{:+.2f}"),
    ("ssim", "SSIM ↑", "{:.4f}", "{:+.4f}"),
    ("ssim_cc", "SSIM, colour-corrected ↑", "{:.4f}", "{:+.4f}"),
    ("ssim_reference_exposure", "SSIM in neutral colours ↑", "{:.4f}", "{:+.4f}"),
    ("lpips_vgg", "LPIPS vgg ↓", "{:.4f}", "{:+.4f}"),
    ("lpips_vgg_cc", "LPIPS vgg, colour-corrected ↓", "{:.4f}", "{:+.4f}"),
    ("lpips_vgg_01", "LPIPS vgg, [0, 1] input ↓", "{:.4f}", "{:+.4f}"),
    ("lpips_vgg_01_cc", "LPIPS vgg, [0, 1] input, colour-corrected ↓", "{:.4f}", "{:+.4f}"),
    ("opacity_coverage", "share of seen pixels that is opaque ↑", "{:.4f}", "{:+.4f}"),
    ("psnr_covered_own_background", "PSNR of seen pixels before its own background (dB) ↑", "{:.2f}", "{:+.2f}"),
    ("psnr_covered_black", "PSNR of seen pixels before black (dB) ↑", "{:.2f}", "{:+.2f}"),
    ("psnr_covered_white", "PSNR of seen pixels before white (dB) ↑", "{:.2f}", "{:+.2f}"),
    ("depth_error_median_expected", "median error of expected depth (camera heights) ↓", "{:.4f}", "{:+.4f}"),
    ("depth_error_median_median", "median error of median depth (camera heights) ↓", "{:.4f}", "{:+.4f}"),
    ("depth_within_1_percent_expected", "share with expected depth within 1 % ↑", "{:.4f}", "{:+.4f}"),
    ("depth_within_1_percent_median", "share with median depth within 1 % ↑", "{:.4f}", "{:+.4f}"),
    ("oversized_splats", "splats larger than the picture, all test views ↓", "{:,.0f}", "{:+,.0f}"),
)


def read_metrics(source: RunFiles) -> tuple[JsonRecord, JsonRecord]:
    """Figures of the coarse and of the merged model; where nothing is merged yet, a run evaluates its coarse model."""
    coarse, merged = (
        source.record(f"{COARSE_EVALUATION}/metrics.json"),
        source.record(f"{MERGED_EVALUATION}/metrics.json"),
    )
    if merged.text("model") == "coarse":
        return coarse or merged, JsonRecord({})
    return coarse, merged


def result_summary(coarse: JsonRecord, merged: JsonRecord) -> str:
    """The result in one line."""
    before, after = coarse.number("psnr"), merged.number("psnr")
    if after is None and before is None:
        return "Nothing is evaluated yet."
    if after is None or before is None:
        name, one = ("Coarse", coarse) if after is None else ("Merged", merged)
        return (
            f"{name} model: PSNR {format_db(one.number('psnr'))} dB (colour-corrected "
            f"{format_db(one.number('psnr_cc'))}), SSIM {format_similarity(one.number('ssim'))}."
        )
    return (
        f"Coarse → merged: PSNR {format_db(before)} → {format_db(after)} dB ({format_difference(after, before)}), colour-corrected "
        f"{_change(coarse, merged, 'psnr_cc', '{:.2f}')} dB; SSIM {_change(coarse, merged, 'ssim', '{:.4f}')}."
    )


def _change(coarse: JsonRecord, merged: JsonRecord, key: str, form: str) -> str:
    before, after = coarse.number(key), merged.number(key)
    signed = form.replace("{:", "{:+")
    return f"{format_value(before, form)} → {format_value(after, form)} ({format_difference(after, before, signed)})"


def result_table(coarse: JsonRecord, merged: JsonRecord) -> Html:
    """Every measure of both models and the difference; measures that neither has are left out."""
    rows = [
        [label, format_value(coarse.number(key), form), format_value(merged.number(key), form),
         format_difference(merged.number(key), coarse.number(key), signed)]
        for key, label, form, signed in METRICS
        if (coarse.number(key), merged.number(key)) != (None, None)
    ]  # fmt: skip
    for key, label, words in (
        ("n_anchors", "anchors", count),
        ("model_bytes", "size of the model", data_size),
        ("fps", "images drawn a second", lambda value: format_value(value, "{:.1f}")),
        ("test_views", "test views", count),
    ):
        pair = coarse.number(key), merged.number(key)
        if pair != (None, None):
            rows.append([label, words(pair[0]), words(pair[1]), ""])
    notes = dict.fromkeys(merged.texts("notes") + coarse.texts("notes"))
    lines = [table(["", "coarse", "merged", "Δ"], rows), *(paragraph(note, "facts") for note in notes)]
    return Html("\n".join(lines))


def views_section(report: ReportedRun) -> Html:
    source = report.files()
    folder = MERGED_EVALUATION if source.has(f"{MERGED_EVALUATION}/per_view.json") else COARSE_EVALUATION
    rows = [row for row in source.rows(f"{folder}/per_view.json") if row.number("psnr") is not None]
    other = (
        {row.text("name"): row for row in source.rows(f"{COARSE_EVALUATION}/per_view.json")}
        if folder == MERGED_EVALUATION
        else {}
    )
    parts: list[Html] = []
    if not rows and not source.exists(f"{MERGED_EVALUATION}/per_view.json", f"{COARSE_EVALUATION}/per_view.json"):
        parts.append(paragraph("No test view is evaluated yet.", "absent"))
    for kind, row in _best_median_worst(rows):
        parts.append(_comparison(source, folder, kind, row, other.get(row.text("name"), JsonRecord({}))))
    parts.append(_least_opaque_view(source, folder, rows))
    sheet = source.image(f"{folder}/contact_sheet.png")
    parts.append(figure(sheet, "All test views (or an even choice of them).", "contact sheet of the test views", True))
    parts.append(details(f"All {len(rows)} test views in numbers", _views_table(rows, other)))
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
    caption = f"{kind}: {name}, {format_db(row.number('psnr'))} dB, SSIM {format_similarity(row.number('ssim'))}"
    if coarse.number("psnr") is not None:
        caption += f" (coarse {format_db(coarse.number('psnr'))} dB)"
    if row.number("mean_visibility") is not None:
        caption += f", mean V {row.number('mean_visibility'):.1f}"
    picture = source.image(f"{folder}/comparisons/{stem}.png") if stem else None
    if picture is None:
        return paragraph(f"{caption}. Its picture is not there.", "absent")
    return figure(picture, f"{caption}.", f"photograph, render and error of {name}", True)


def _least_opaque_view(source: RunFiles, folder: str, rows: list[JsonRecord]) -> Html:
    """Alpha of the view with the lowest share of opaque pixels: where ground is half transparent, it is grey."""
    known = [(solid, row) for row in rows if (solid := row.number("opacity_coverage")) is not None and row.text("alpha")]
    if not known:
        return Html("")
    solid, row = min(known, key=lambda each: each[0])
    name, stem = row.text("name") or "unnamed", PurePosixPath(row.text("alpha") or "").stem
    caption = (
        f"Least solid: alpha of {name}, white is opaque. Of its pixels that at least 3 training cameras see, "
        f"{format_percent(solid)} have alpha of at least 0.95."
    )
    return figure(source.image(f"{folder}/alpha/{stem}.png"), caption, f"alpha of {name}")


def _views_table(rows: list[JsonRecord], other: dict[str | None, JsonRecord]) -> Html:
    lines = []
    for row in rows[:MAX_VIEW_ROWS]:
        before = other.get(row.text("name"), JsonRecord({})).number("psnr")
        lines.append(
            [
                row.text("name") or ABSENT,
                format_value(row.number("mean_visibility"), "{:.2f}"),
                format_db(before),
                format_db(row.number("psnr")),
                format_difference(row.number("psnr"), before),
                format_db(row.number("psnr_cc")),
                format_similarity(row.number("ssim")),
                format_similarity(row.number("lpips_vgg")),
                format_percent(row.number("opacity_coverage")),
                count(row.number("oversized_splats")),
            ]
        )
    head = ["view", "mean V", "PSNR coarse", "PSNR", "Δ", "PSNR cc", "SSIM", "LPIPS vgg", "solid", "large splats"]
    caption = f"The first {MAX_VIEW_ROWS} of {len(rows)}" if len(rows) > MAX_VIEW_ROWS else ""
    return table(head, lines, caption)


def by_visibility_section(report: ReportedRun) -> Html:
    source = report.files()
    coarse, merged = read_metrics(source)
    bins = merged.rows("by_visibility") or coarse.rows("by_visibility")
    theirs = {_bounds(row): row for row in coarse.rows("by_visibility")}
    pairs = [(theirs.get(_bounds(row), JsonRecord({})), row if merged else JsonRecord({})) for row in bins]
    parts = [paragraph("Pixels of all test views, by the number V of training photographs that see the place drawn.")]
    if not bins:
        parts.append(paragraph("There are no figures by visibility yet.", "absent"))
    names = [_bounds(row) for row in bins]
    parts.append(_bins_table(bins, pairs))
    before, after = ([each.number("psnr") for each in side] for side in zip(*pairs, strict=True)) if pairs else ([], [])
    gains = [None if a is None or b is None else a - b for b, a in zip(before, after, strict=True)]
    labels = [name.replace(" to ", "–").replace(" ", "\n") for name in names]
    parts.append(
        gallery(
            [figure(draw_psnr_bars(labels, before, after), "", "PSNR by visibility"),
             figure(draw_gain_bars(labels, gains), "", "gain of PSNR by visibility")]
        )
    )  # fmt: skip
    return section("by-visibility", "Quality by visibility", parts, source.notes)


def _bounds(row: JsonRecord) -> str:
    lower, upper = row.number("lower"), row.number("upper")
    return "nothing drawn" if lower is None or upper is None else format_bounds(lower, upper)


def _bins_table(bins: list[JsonRecord], pairs: list[tuple[JsonRecord, JsonRecord]]) -> Html:
    rows = []
    for row, (coarse, merged) in zip(bins, pairs, strict=True):
        line = [_bounds(row), count(row.number("pixels"))]
        for key, form, signed in (("psnr", "{:.2f}", "{:+.2f}"), ("psnr_cc", "{:.2f}", "{:+.2f}"),
                                  ("ssim", "{:.4f}", "{:+.4f}")):  # fmt: skip
            before, after = coarse.number(key), merged.number(key)
            line += [format_value(before, form), format_value(after, form), format_difference(after, before, signed)]
        rows.append(line)
    head = ["V", "pixels", "PSNR coarse", "merged", "Δ", "PSNR cc coarse", "merged", "Δ", "SSIM coarse", "merged", "Δ"]
    return table(head, rows)


def seams_section(report: ReportedRun) -> Html:
    source = report.files()
    facts = source.record(f"{MERGED_EVALUATION}/by_block.json")
    parts: list[Html] = []
    if not facts and not source.exists(f"{MERGED_EVALUATION}/by_block.json"):
        parts.append(paragraph("There are no figures by block: fewer than two blocks are merged.", "absent"))
    rows = [_block_row(count(row.number("block")), row) for row in facts.rows("blocks")]
    if rows and facts.child("all"):
        rows.append(_block_row("all", facts.child("all")))
    head = ["block", "pixels", "PSNR coarse", "PSNR isolated", "PSNR merged", "merged − coarse"]
    parts.append(
        table(
            head,
            rows,
            "PSNR pooled over the pixels of test views that show a block (not a mean over views). "
            "Alone: the block as trained, before the merge",
        )
    )
    parts.append(paragraph(_seam_sentence(facts.child("seams"))))
    parts += _seam_images(source, facts.rows("views"))
    return section("seams", "Per block, and the seams between blocks", parts, source.notes)


def _block_row(name: str, row: JsonRecord) -> list[str]:
    before, isolated, after = (row.number(f"psnr_{key}") for key in ("coarse", "isolated", "merged"))
    return [
        name,
        count(row.number("pixels")),
        format_db(before),
        format_db(isolated),
        format_db(after),
        format_difference(after, before),
    ]


def _seam_sentence(seams: JsonRecord) -> str:
    ratio = seams.number("seam_mae_ratio")
    if ratio is None:
        return ""
    near, pixels = seams.number("border_px"), seams.number("border_pixels")
    return (
        f"Within {format_value(near, '{:g}')} px of a border between blocks ({count(pixels)} pixels), the error relative "
        f"to elsewhere is {ratio:.2f} times what it is in the coarse model, which has no seams (mean absolute error; "
        f"squared error {format_value(seams.number('seam_mse_ratio'), '{:.2f}')}). 1 is no seam; above 1, borders got worse."
    )


def _seam_images(source: RunFiles, views: list[JsonRecord]) -> list[Html]:
    """The views in which most pixels lie near a border."""
    names = [row.text("name") or "" for row in views]
    near = [row.number("border_pixels") or 0.0 for row in views]
    found = [
        (-pixels, name, f"{MERGED_EVALUATION}/seams/{stem}.png")
        for pixels, name, stem in zip(near, names, unique_file_stems(names), strict=True)
        if source.has(f"{MERGED_EVALUATION}/seams/{stem}.png")
    ]
    return [
        figure(source.image(file), f"{name}: the model before and after the merge.", f"seams in {name}", True)
        for _, name, file in sorted(found)[:MAX_SEAM_IMAGES]
    ]
