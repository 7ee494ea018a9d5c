"""The sections of the report, each from files of the run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vdgs.report import charts, page
from vdgs.report.reading import (
    change,
    get,
    gigabytes,
    minutes,
    number,
    read_log,
    read_mapping,
    read_rows,
    read_settings,
    rows_of,
    shown,
    words_of,
)
from vdgs.run import RunFolder, StageFolder

#: key of metrics.json, what people call it, format
QUALITY = (
    ("psnr", "PSNR (dB)", "{:.2f}"), ("psnr_cc", "PSNR, colour-corrected", "{:.2f}"), ("ssim", "SSIM", "{:.4f}"),
    ("ssim_cc", "SSIM, colour-corrected", "{:.4f}"), ("lpips_vgg", "LPIPS vgg", "{:.4f}"),
    ("lpips_vgg_01", "LPIPS vgg, [0,1] input", "{:.4f}"),
)  # fmt: skip
#: Seam pictures shown at most.
SEAM_PICTURES = 4


class Models:
    """What was measured of the coarse and of the final model."""

    def __init__(self, run: RunFolder):
        final = read_mapping(run.evaluation / "metrics.json")
        coarse = read_mapping(run.coarse.path / "evaluation" / "metrics.json")
        if final is not None and final.get("model") == "coarse":  # a run without blocks, so far
            coarse, final = coarse or final, None
        self.coarse, self.merged = coarse, final
        self.folder = run.evaluation if (run.evaluation / "metrics.json").exists() else run.coarse.path / "evaluation"


def header(run: RunFolder, models: Models) -> list[str]:
    capture, settings = read_mapping(run.capture_file), read_settings(run.config_file)
    name = Path(str(get(capture, "root") or run.path)).name
    version = get(settings, "vdgs", "version") or "?"
    commit = str(get(settings, "vdgs", "commit") or "")[:10]
    train, test = (len(words_of(get(capture, key))) for key in ("training_views", "test_views"))
    parts = [
        f"<h1>{page.escape(name)}</h1>",
        page.paragraph(
            f"{train} training and {test} test views · {get(capture, 'images') or ''} · vdgs {version}"
            + (f" ({commit})" if commit else ""),
            "faint",
        ),
    ]
    best = models.merged or models.coarse
    if best is None:
        return [*parts, page.paragraph("Nothing is measured yet.", "faint")]
    items = [(label, shown(best.get(key), form), "") for key, label, form in QUALITY[:3]]
    if models.merged and models.coarse:
        gain = number(models.merged.get("psnr")), number(models.coarse.get("psnr"))
        better = None not in gain and gain[0] >= gain[1]  # type: ignore[operator]
        delta = change(models.coarse.get("psnr"), models.merged.get("psnr"), "{:+.2f} dB")
        items.append(("blocks against coarse", delta, "up" if better else "down"))
    items.append(("anchors", shown(best.get("n_anchors"), "{:,.0f}"), ""))
    return [*parts, page.verdict(items)]


def visibility(run: RunFolder) -> list[str]:
    facts = read_mapping(run.visibility / "visibility.json")
    parts = [page.picture(run.visibility / "map.png", "How many training cameras see each part of the scene")]
    if facts:
        quantiles = facts.get("quantiles")
        listed = (
            ", ".join(f"{k} %: {shown(v, '{:g}')}" for k, v in quantiles.items())
            if isinstance(quantiles, dict)
            else "–"
        )
        parts.append(
            page.paragraph(f"V by quantile of the anchors: {listed}. Gini coefficient {shown(facts.get('gini'))}.")
        )
    return parts


def blocks(run: RunFolder) -> list[str]:
    facts = read_mapping(run.partition / "partition.json")
    parts = [
        page.picture(run.partition / "blocks.png", "The blocks from above, and the cut that place alone would give"),
        page.picture(run.partition / "block_facts.png", "Anchors, cameras, area and visibility of each block"),
    ]
    rows = rows_of(get(facts, "blocks"))
    if rows:
        head = (
            "block",
            "cameras",
            "above threshold",
            "best block",
            "topped up",
            "anchors",
            "with the ring",
            "mean V",
            "area",
        )
        keys = ("cameras", "above_threshold", "best_block", "topped_up", "anchors_core", "anchors_expanded")
        cells = [
            [shown(row.get("block"), "{:.0f}"), *(shown(row.get(key), "{:,.0f}") for key in keys),
             shown(row.get("mean_v"), "{:.1f}"), shown(row.get("area"), "{:,.0f}")]
            for row in rows
        ]  # fmt: skip
        parts.append(page.table(head, cells))
    for note in words_of(get(facts, "warnings")) + words_of(get(facts, "complaints")):
        parts.append(page.paragraph(note, "note"))
    return parts


def assignment(run: RunFolder) -> list[str]:
    return [
        page.picture(run.partition / "scores.png", "How well each camera shows each block", widest=900),
        page.paragraph("The whole score matrix is in partition/scores.npz.", "faint"),
    ]


def training(run: RunFolder) -> list[str]:
    logs = {int(folder.path.name): read_log(folder.log) for folder in run.block_folders() if folder.path.name.isdigit()}
    curves, cycles = charts.training_curves(read_log(run.coarse.log), logs), charts.growth_cycles(logs)
    parts = [
        page.figure(curves, "Training of the coarse model and of each block") if curves else page.missing("Training")
    ]
    if cycles:
        parts.append(page.figure(cycles, "Compensated growth, cycle by cycle (eqs. 8–10)"))
    return parts


def test_views(models: Models) -> list[str]:
    parts = [
        page.picture(models.folder / "contact_sheet.png", "Test views, photograph above, render below", photograph=True)
    ]
    rows = [row for row in read_rows(models.folder / "per_view.json") if number(row.get("psnr")) is not None]
    rows.sort(key=lambda row: row["psnr"])
    chosen = {"worst": 0, "median": len(rows) // 2, "best": len(rows) - 1} if len(rows) > 2 else {}
    for name, place in chosen.items():
        stem = Path(str(rows[place].get("render"))).stem
        caption = f"The {name} test view: {rows[place].get('name')}, {rows[place]['psnr']:.2f} dB"
        parts.append(page.picture(models.folder / "comparisons" / f"{stem}.png", caption, photograph=True))
    return parts


def quality(models: Models) -> list[str]:
    if models.coarse is None and models.merged is None:
        return [page.missing("Metrics")]
    coarse, merged = models.coarse or {}, models.merged or {}
    parts = [
        page.table(
            ("test views", "coarse", "merged", "change"),
            [[label, shown(coarse.get(key), form), shown(merged.get(key), form),
              change(coarse.get(key), merged.get(key), form.replace("{:", "{:+"))] for key, label, form in QUALITY],
        )
    ]  # fmt: skip
    first, second = (_bins(model) for model in (coarse, merged))
    drawn = charts.by_visibility(first, second)
    if drawn:
        parts.append(page.figure(drawn, "Quality where few cameras look (left) and where many do (right)"))
    rows = second or first
    if rows:
        head = ("V", "pixels", "coarse PSNR", "merged PSNR", "coarse SSIM", "merged SSIM")
        cells = []
        for index, row in enumerate(rows):
            pair = [bins[index] if index < len(bins) else {} for bins in (first, second)]
            bounds = (
                "nothing drawn"
                if row.get("lower") is None
                else f"{shown(row.get('lower'))} to {shown(row.get('upper'))}"
            )
            cells.append([bounds, shown(row.get("pixels"), "{:,.0f}"), *(shown(each.get("psnr")) for each in pair),
                          *(shown(each.get("ssim"), "{:.4f}") for each in pair)])  # fmt: skip
        parts.append(page.table(head, cells))
    notes = words_of((merged or coarse).get("notes"))
    return parts + [page.paragraph(note, "faint") for note in notes]


def seams(run: RunFolder) -> list[str]:
    facts = read_mapping(run.evaluation / "by_block.json")
    if facts is None:
        return [page.missing("Quality by block (a scene of one block has none)")]
    rows = rows_of(facts.get("blocks"))
    parts = [
        page.table(
            ("block", "test pixels", "coarse PSNR", "as trained, alone", "merged PSNR"),
            [[shown(row.get("block"), "{:.0f}"), shown(row.get("pixels"), "{:,.0f}"),
              *(shown(row.get(f"psnr_{name}")) for name in ("coarse", "alone", "merged"))] for row in rows],
        ),
        page.paragraph(
            "Mean absolute error within 10 px of a border between blocks, over the error elsewhere: "
            f"{shown(get(facts, 'seams', 'mae_merged', 'ratio'), '{:.3f}')} for the merged scene, "
            f"{shown(get(facts, 'seams', 'mae_coarse', 'ratio'), '{:.3f}')} for the coarse one, which has no seams."
        ),
    ]  # fmt: skip
    for path in sorted((run.evaluation / "seams").glob("*.png"))[:SEAM_PICTURES]:
        parts.append(page.picture(path, f"Borders of blocks in {path.stem}", photograph=True))
    return parts


def costs(run: RunFolder) -> list[str]:
    rows = [_cost("coarse model", run.coarse)]
    partition = read_mapping(run.partition / "partition.json") or {}
    rows.append(
        [
            "partition and cameras",
            minutes(partition.get("seconds")),
            gigabytes(partition.get("peak_memory_bytes")),
            "–",
            "–",
        ]
    )
    rows += [
        _cost(f"block {int(folder.path.name)}", folder) for folder in run.block_folders() if folder.path.name.isdigit()
    ]
    merged = read_mapping(run.merged.status_file) or {}
    rows.append(["merge", minutes(merged.get("merge_seconds")), gigabytes(merged.get("merge_peak_memory_bytes")), "–",
                 shown(merged.get("anchors"), "{:,.0f}")])  # fmt: skip
    for name, folder in (
        ("evaluation, coarse", run.coarse.path / "evaluation"),
        ("evaluation, merged", run.evaluation),
    ):
        facts = read_mapping(folder / "status.json") or {}
        rows.append([name, minutes(facts.get("seconds")), gigabytes(facts.get("peak_memory_bytes")), "–", "–"])
    return [page.table(("stage", "time", "peak memory", "iterations", "anchors"), rows)]


def settings(run: RunFolder) -> list[str]:
    try:
        text = run.config_file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return [page.missing("config.yaml")]
    return [page.details("config.yaml: everything that the result depends on", text)]


def _cost(name: str, folder: StageFolder) -> list[str]:
    facts: dict[str, Any] = read_mapping(folder.status_file) or {}
    return [
        name + (f" ({facts['state']})" if facts.get("state") not in (None, "done") else ""),
        minutes(facts.get("seconds")), gigabytes(facts.get("peak_memory_bytes")),
        shown(facts.get("iteration"), "{:,.0f}"), shown(facts.get("anchors"), "{:,.0f}"),
    ]  # fmt: skip


def _bins(metrics: dict[str, Any]) -> list[dict[str, Any]]:
    return rows_of(metrics.get("by_visibility"))
