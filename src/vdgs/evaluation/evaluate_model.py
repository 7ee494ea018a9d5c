"""Evaluates a model on views: every figure that papers report, raw, color-corrected, by visibility; opacity; images.
One view is in memory at a time.

    OUTPUT/
      metrics.json        means over the views, bins by visibility, size and speed of the model
      per_view.json       the same figures for each view
      renders/NAME.png    what the model shows, in the exposure of the view if it says so, 8 bits: what is measured
      alpha/NAME.png      how opaque it is: black nothing, white opaque; none if the renderer does not say
      comparisons/        photograph | render | error
      contact_sheet.png   all views (or an even choice of them) at a glance
"""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from rich.console import Console

from vdgs.captures.capture import View
from vdgs.errors import RunError
from vdgs.evaluation import comparison_images
from vdgs.evaluation.by_visibility import VisibilityHistogram, mean_or_none, view_bins
from vdgs.evaluation.depth_errors import METRIC_NAMES, DepthErrors, summarize_depth_errors
from vdgs.evaluation.lpips import Lpips
from vdgs.evaluation.metric_tables import make_metrics_table
from vdgs.evaluation.metrics import MAX_PSNR_DB
from vdgs.evaluation.opacity_coverage import summarize_opacity_coverage, summarize_oversized_splats
from vdgs.evaluation.renderable_model import EvaluatedModel, EvaluationSettings, ReferenceViews, RenderableModel
from vdgs.evaluation.splat_artifacts import ANGLE_EDGES, ARTIFACT_KEYS, summarize_artifacts
from vdgs.evaluation.view_metrics import (
    AFFINE_KEYS,
    CORRECTED_KEYS,
    RAW_KEYS,
    REFERENCE_EXPOSURE_KEYS,
    ViewInputs,
    ViewMetrics,
    measure_view,
)
from vdgs.system.atomic_files import to_jsonable, write_json
from vdgs.system.console import print_once
from vdgs.system.documents import EvaluationMetrics, JsonObject
from vdgs.system.stop_signals import check_stop_requested


@dataclass(eq=False)
class _MetricTotals:
    """What accumulates over the views."""

    rows: list[JsonObject] = field(default_factory=list)
    cells: list[comparison_images.Thumbnail] = field(default_factory=list)
    histogram: VisibilityHistogram | None = None
    by_angle: VisibilityHistogram | None = None
    depth_errors: dict[str, DepthErrors] = field(default_factory=dict)

    def add(self, figures: ViewMetrics) -> None:
        self.rows.append(figures.row)
        if figures.cell is not None:
            self.cells.append(figures.cell)
        if figures.by_visibility is not None:
            self.histogram = self.histogram or VisibilityHistogram(figures.by_visibility.names)
            self.histogram.merge(figures.by_visibility)
        if figures.by_angle is not None:
            self.by_angle = self.by_angle or VisibilityHistogram(figures.by_angle.names)
            self.by_angle.merge(figures.by_angle)
        for kind, errors in figures.depth_errors.items():
            self.depth_errors.setdefault(kind, DepthErrors()).merge(errors)


def evaluate_model(
    reference_views: ReferenceViews,
    model: RenderableModel,
    output: Path,
    *,
    lpips: Lpips | None = None,
    lpips_note: str = "",
    settings: EvaluationSettings | None = None,
    console: Console | None = None,
    on_view: Callable[[int], object] = lambda _done: None,
) -> EvaluationMetrics:
    """Render and measure every view, write `output`, and return what `metrics.json` holds.

    `lpips_note` says why LPIPS is null. A table is printed to `console` if there is one. fps is one over the median
    time of `model.render`, which on a GPU includes waiting for it; None unless `model.timed`.

    Raises RunError without views, CaptureError where a photograph or mask does not fit its camera,
    TrainingDiverged where a render is not finite.
    """
    require_views(reference_views.views, output)
    inputs = ViewInputs(reference_views, model, lpips, settings or EvaluationSettings(), output)

    def measure(index: int) -> ViewMetrics:
        check_stop_requested()
        measured = measure_view(index, inputs)
        on_view(index + 1)
        return measured

    return summarize_views(
        map(measure, range(len(reference_views.views))), model.metadata, output,
        lpips_note=lpips_note, settings=inputs.settings, timed=model.is_timed, console=console,
    )  # fmt: skip


def require_views(views: Sequence[View], output: Path) -> None:
    """Raise RunError where there is nothing to measure."""
    if not views:
        raise RunError(
            f"{output}: there are no test views to evaluate. Hold some out when the capture is read "
            "(by default every 8th image is)."
        )


def summarize_views(
    per_view_metrics: Iterable[ViewMetrics],
    metadata: EvaluatedModel,
    output: Path,
    *,
    lpips_note: str,
    settings: EvaluationSettings,
    timed: bool,
    console: Console | None,
) -> EvaluationMetrics:
    """Gather views, in their order, into the figures of all; otherwise as `evaluate_model`. One view is in memory."""
    gathered = _MetricTotals()
    for figures in per_view_metrics:
        gathered.add(figures)
    result = _summary(gathered, metadata, lpips_note, settings, timed)
    _write(output, result, gathered, settings.title)
    if console is not None:
        console.print(make_metrics_table(result, f"{len(gathered.rows)} {settings.title}"))
        for note in result["notes"]:
            print_once(console, note, "yellow")
    return result


def _summary(
    gathered: _MetricTotals, metadata: EvaluatedModel, lpips_note: str, settings: EvaluationSettings, timed: bool
) -> EvaluationMetrics:
    rows, keys = gathered.rows, RAW_KEYS + CORRECTED_KEYS + AFFINE_KEYS
    pixel_bins = gathered.histogram.bins(settings.visibility_bins) if gathered.histogram else None
    visible = [np.nan if row["mean_visibility"] is None else row["mean_visibility"] for row in rows]
    figures = [{name: row[name] for name in keys} for row in rows]
    unfitted = sum(row.get("color_correction_fitted") is False for row in rows)
    notes = [note for note in (lpips_note, _exposure_note(rows, settings)) if note]
    if unfitted:
        notes.append(f"color correction: too few unsaturated pixels in {unfitted} views, left as they are")
    if equal := sum((row["psnr"] or 0.0) >= MAX_PSNR_DB for row in rows):
        bound = f"PSNR {MAX_PSNR_DB:g} dB each, the most that counts"
        notes.append(f"{equal} of {len(rows)} views equal their photographs (or all but): {bound}")
    result = {
        **{name: mean_or_none([row[name] for row in rows]) for name in keys + REFERENCE_EXPOSURE_KEYS},
        "by_visibility": pixel_bins,
        "views_by_visibility": view_bins(visible, figures, settings.visibility_bins) if pixel_bins else None,
        **summarize_opacity_coverage(rows),
        **summarize_depth_errors(gathered.depth_errors),
        **summarize_oversized_splats(rows),
        **summarize_artifacts(rows),
        "by_angle": gathered.by_angle.bins_at(ANGLE_EDGES) if gathered.by_angle else None,
        "sets": _by_folder(rows) if settings.by_folder else None,
        **asdict(metadata),
        "fps": 1.0 / max(statistics.median(row["render_seconds"] for row in rows), 1e-9) if timed else None,
        settings.title.replace(" ", "_").replace("-", "_"): len(rows),
        "notes": notes,
    }
    measured: EvaluationMetrics = to_jsonable(result)
    return measured


def _by_folder(rows: Sequence[Mapping[str, Any]]) -> dict[str, JsonObject]:
    """Means over the views of each folder."""
    keys, folders = (*RAW_KEYS, *METRIC_NAMES, *ARTIFACT_KEYS), defaultdict[str, list[Mapping[str, Any]]](list)
    for row in rows:
        folders[PurePosixPath(row["name"]).parts[0]].append(row)
    return {
        folder: {"views": len(of)} | {key: mean_or_none([row[key] for row in of]) for key in keys}
        for folder, of in sorted(folders.items())
    }


def _exposure_note(rows: Sequence[Mapping[str, Any]], settings: EvaluationSettings) -> str:
    """How the views are exposed; empty where all are in neutral colors."""
    exposures = [exposure for row in rows if (exposure := row.get("exposure")) is not None]
    if not exposures:
        return ""
    alone = sum(np.array_equal(exposure, np.eye(3, 4)) for exposure in exposures)
    without = f"; {alone} of them neutral, for want of training photographs near by" if alone else ""
    return f"views are drawn and measured {settings.exposure_note}{without}; beside that in neutral colors"


def _write(output: Path, result: Mapping[str, Any], gathered: _MetricTotals, title: str) -> None:
    if gathered.cells:
        count = len(gathered.rows)
        shown = f"{len(gathered.cells)} of {count}" if len(gathered.cells) < count else f"{count}"
        psnr = "PSNR –" if result["psnr"] is None else f"PSNR {result['psnr']:.2f} dB"
        ssim = "SSIM –" if result["ssim"] is None else f"SSIM {result['ssim']:.3f}"
        sheet = comparison_images.draw_contact_sheet(gathered.cells, f"{shown} {title} · {psnr} · {ssim}")
        comparison_images.write_png(output / "contact_sheet.png", np.asarray(sheet))
    write_json(output / "per_view.json", to_jsonable(gathered.rows))
    write_json(output / "metrics.json", result)  # last: where it stands, the rest is complete
