"""Evaluate a model on views, mostly its test views: every figure that papers report, raw and colour-corrected, and by
visibility; whether it is opaque where photographs show ground; the pictures behind that. One view is in memory at a
time.

    OUTPUT/
      metrics.json        means over the views, bins by visibility, size and speed of the model
      per_view.json       the same figures for each view
      renders/NAME.png    what the model shows, 8 bits: the images that are measured
      alpha/NAME.png      how opaque it is: black nothing, white opaque; none if the renderer does not say
      comparisons/        photograph | render | error
      contact_sheet.png   all views (or an even choice of them) at a glance
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from rich.console import Console
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.captures.capture import View
from vdgs.errors import CaptureError, RunError, TrainingDiverged
from vdgs.evaluation import metrics, pictures, saving
from vdgs.evaluation.by_visibility import QUANTILE_BINS, VisibilityHistogram, mean_or_none, view_bins
from vdgs.evaluation.colour import correct_colours, correct_colours_affinely
from vdgs.evaluation.depth_errors import DepthErrors, errors_of_view, figures_of
from vdgs.evaluation.lpips import MIN_SIDE_PX, Lpips
from vdgs.evaluation.reference_views import ReferenceViews
from vdgs.evaluation.solidity import (
    Rendered,
    larger_than_picture,
    largest_splats_of_all,
    solidity_of_all,
    solidity_of_view,
)
from vdgs.evaluation.tables import metrics_table
from vdgs.kernels.types import Raster, Splats
from vdgs.storage.files import jsonable, write_json
from vdgs.watching.interrupts import stop_if_asked

RAW = ("psnr", "ssim", "lpips_vgg", "lpips_vgg_01")
CORRECTED = tuple(f"{name}_cc" for name in RAW)
#: After one affine map of the colours, which is fitted on the view too.
AFFINE = ("psnr_affine", "ssim_affine")


class RenderedView(Protocol):
    """What a renderer returns; `alpha` [h, w] may come with it, as in `Raster`."""

    @property
    def image(self) -> Float[Tensor, "h w 3"]: ...


@dataclass(frozen=True)
class ModelFacts:
    """What the evaluation reports of the model but cannot measure itself; None is unknown."""

    #: "coarse" or "merged".
    model: str | None = None
    n_anchors: int | None = None
    model_bytes: int | None = None
    train_seconds: float | None = None
    peak_memory_bytes: int | None = None
    #: What tells the model from any other, and the settings that it was made with (`runs.keys`).
    model_identity: str | None = None
    key: str | None = None


@dataclass(frozen=True, eq=False)
class MeasuredModel:
    """A model as the evaluation sees it. Whatever is None is not known, and so are the figures that need it."""

    #: Timed: the plain picture, with alpha if the renderer has it.
    render: Callable[[Camera], RenderedView]
    #: V per pixel [h, w], NaN where the model shows nothing; without it there are no figures by visibility.
    visibility_map: Callable[[Camera], Float[np.ndarray, "h w"]] | None = None
    facts: ModelFacts = ModelFacts()
    #: Whether the time that `render` takes says anything.
    timed: bool = True
    #: What is behind the model in a render, RGB in [0, 1].
    background: tuple[float, float, float] | None = None
    #: Pixels that show what enough training cameras see (`evaluation.seen`); solidity and depth are measured on them.
    seen_map: Callable[[Camera], Bool[np.ndarray, "h w"]] | None = None
    #: Depth along the axis of a view's camera, inf for sky; then these two are needed as well: the model's own depth
    #: (not timed), and how high cameras are above ground. All in the units of the model.
    true_depth: Callable[[View], Float[np.ndarray, "h w"]] | None = None
    render_depth: Callable[[Camera], Raster] | None = None
    camera_height: float | None = None
    #: The splats that a view is drawn from.
    splats_of: Callable[[Camera], Splats] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a true depth without what it is compared with."""
        if self.true_depth is not None and (self.render_depth is None or not self.camera_height):
            raise ValueError("true_depth needs render_depth and a camera_height above 0")


@dataclass(frozen=True)
class EvaluationSettings:
    """What to measure and draw."""

    #: Also report every figure after colour correction (fitted on the test image itself).
    colour_correction: bool = True
    #: Bins by visibility, of about equal size.
    visibility_bins: int = QUANTILE_BINS
    #: Write photograph | render | error for every view.
    comparisons: bool = True
    #: What the contact sheet calls the views, and, with _ between its words, metrics.json their number.
    title: str = "test views"
    #: Views on the contact sheet at most, chosen evenly.
    contact_views: int = 40
    #: Error at the bright end of the colour map, where white is 1.
    error_limit: float = pictures.ERROR_LIMIT


@dataclass(frozen=True, eq=False)
class _Inputs:
    """What every view is measured with."""

    photographs: ReferenceViews
    model: MeasuredModel
    lpips: Lpips | None
    settings: EvaluationSettings
    output: Path


@dataclass(eq=False)
class _Gathered:
    """What accumulates over the views."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    cells: list[pictures.Thumbnail] = field(default_factory=list)
    histogram: VisibilityHistogram | None = None
    depth_errors: dict[str, DepthErrors] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Pair:
    """A render (8 bits) against its photograph, and the mask of what counts."""

    image: UInt8[np.ndarray, "h w 3"]
    reference: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"] | None


def evaluate(
    photographs: ReferenceViews,
    model: MeasuredModel,
    output: Path,
    *,
    lpips: Lpips | None = None,
    lpips_note: str = "",
    settings: EvaluationSettings | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Render and measure every view, write `output`, and return what `metrics.json` holds.

    `lpips_note` says why LPIPS is null. A table is printed to `console` if there is one. fps is one over the median
    time of `model.render`, which on a GPU includes waiting for it; None unless `model.timed`.

    Raises RunError without views, CaptureError where a photograph or mask does not fit its camera,
    TrainingDiverged where a render is not finite.
    """
    views = photographs.views
    if not views:
        raise RunError(
            f"{output}: there are no test views to evaluate. Hold some out when the capture is read "
            "(by default every 8th image is)."
        )
    settings = settings or EvaluationSettings()
    inputs = _Inputs(photographs, model, lpips, settings, output)
    suffixes = ["", "_cc", "_affine"] if settings.colour_correction else [""]
    names = [f"{name}{suffix}" for suffix in suffixes for name in ("squared_error", "ssim")]
    gathered = _Gathered(histogram=VisibilityHistogram(names) if model.visibility_map else None)
    stems = saving.file_stems([view.name for view in views])
    on_sheet = set(np.linspace(0, len(views) - 1, min(len(views), settings.contact_views)).round().astype(int))
    for index, view in enumerate(views):
        stop_if_asked()
        _evaluate_view(view, stems[index], index in on_sheet, inputs, gathered)
    result = _summary(gathered, model, lpips_note, settings)
    _write(output, result, gathered, settings.title)
    if console is not None:
        console.print(metrics_table(result, f"{len(views)} {settings.title}"))
    return result


def _evaluate_view(view: View, stem: str, on_sheet: bool, inputs: _Inputs, gathered: _Gathered) -> None:
    settings = inputs.settings
    reference, mask = _photograph(view, inputs.photographs)
    rendered, seconds = _rendered(view, inputs.model)
    image = metrics.to_8bit(rendered.image)
    saving.write_png(inputs.output / "renders" / f"{stem}.png", image)
    raw = _Pair(image, reference, mask)
    maps = _maps(raw, "")
    row: dict[str, Any] = {
        "name": view.name,
        "render": f"renders/{stem}.png",
        "alpha": _write_alpha(inputs.output, stem, rendered),
        **_figures(raw, maps, "", inputs.lpips),
    }
    if settings.colour_correction:
        correction = correct_colours(image, reference, mask)
        corrected = _Pair(metrics.to_8bit(correction.image), reference, mask)
        corrected_maps = _maps(corrected, "_cc")
        row |= _figures(corrected, corrected_maps, "_cc", inputs.lpips)
        row["colour_fitted"] = correction.fitted
        affine = _Pair(metrics.to_8bit(correct_colours_affinely(image, reference, mask).image), reference, mask)
        affine_maps = _maps(affine, "_affine")
        row |= {name: value for name, value in _figures(affine, affine_maps, "_affine", None).items() if name in AFFINE}
        maps |= corrected_maps | affine_maps
    else:
        row |= dict.fromkeys((*CORRECTED, *AFFINE))
    visibility = None if inputs.model.visibility_map is None else np.asarray(inputs.model.visibility_map(view.camera))
    row["mean_visibility"] = _count_visibility(visibility, gathered, maps, mask)
    seen = _seen(view, inputs.model, mask)
    row |= solidity_of_view(rendered, reference, seen)
    row |= _depth_figures(view, inputs.model, seen, gathered)
    row["largest_splats"] = _largest_splats(view, inputs.model)
    row["kept_pixels"] = image.shape[0] * image.shape[1] if mask is None else int(mask.sum())
    row["render_seconds"] = seconds
    gathered.rows.append(row)
    gathered.seconds.append(seconds)
    _draw(view, stem, on_sheet, raw, row, inputs, gathered)


def _photograph(
    view: View, photographs: ReferenceViews
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
    reference, mask = photographs.load_image(view), photographs.load_mask(view)
    wanted = (view.camera.height, view.camera.width)
    for what, shape in (
        ("photograph", reference.shape[:2]),
        ("mask", wanted if mask is None else mask.shape),
    ):
        if shape != wanted:
            raise CaptureError(
                f"{view.image_path}: the {what} of {view.name} is {shape[1]} x {shape[0]} pixels, its camera "
                f"{wanted[1]} x {wanted[0]}. Use images of the size that the camera describes."
            )
    return reference, mask


def _rendered(view: View, model: MeasuredModel) -> tuple[Rendered, float]:
    """The render and the seconds it took, the GPU's work included."""
    with torch.inference_mode():
        _wait_for_gpu()
        start = time.perf_counter()
        rendered = model.render(view.camera)
        _wait_for_gpu()
        seconds = time.perf_counter() - start
        pixels = _on_cpu(rendered.image)
        alpha = getattr(rendered, "alpha", None)
    if pixels.shape != (view.camera.height, view.camera.width, 3):
        raise ValueError(f"the render of {view.name} has shape {list(pixels.shape)}")
    if not np.isfinite(pixels).all():
        raise TrainingDiverged(
            f"the render of {view.name} holds values that are not finite numbers: the model is damaged. "
            "Evaluate an earlier state, or train again with lower rates."
        )
    return Rendered(pixels, None if alpha is None else _on_cpu(alpha), model.background), seconds


def _on_cpu(values: Tensor) -> np.ndarray:
    pixels: np.ndarray = torch.as_tensor(values).detach().to("cpu", torch.float32).numpy()
    return pixels


def _write_alpha(output: Path, stem: str, rendered: Rendered) -> str | None:
    """Write the picture of alpha, if it is known; its name in the output folder."""
    if rendered.alpha is None:
        return None
    name = f"alpha/{stem}.png"
    saving.write_png(output / name, np.repeat(metrics.to_8bit(rendered.alpha)[..., None], 3, axis=2))
    return name


def _wait_for_gpu() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _maps(pair: _Pair, suffix: str) -> dict[str, Float[np.ndarray, "h w"]]:
    return {
        f"squared_error{suffix}": metrics.squared_error(pair.image, pair.reference),
        f"ssim{suffix}": metrics.ssim_map(pair.image, pair.reference, pair.mask),
    }


def _figures(pair: _Pair, maps: Mapping[str, np.ndarray], suffix: str, lpips: Lpips | None) -> dict[str, float | None]:
    """The four figures of a pair; LPIPS is None without weights or where the image is too small for it."""
    figures: dict[str, float | None] = {
        f"psnr{suffix}": metrics.psnr_of(metrics.masked_mean(maps[f"squared_error{suffix}"], pair.mask)),
        f"ssim{suffix}": metrics.masked_mean(maps[f"ssim{suffix}"], pair.mask),
        f"lpips_vgg{suffix}": None,
        f"lpips_vgg_01{suffix}": None,
    }
    nothing_kept = pair.mask is not None and not pair.mask.any()
    if lpips is not None and not nothing_kept and min(pair.image.shape[:2]) >= MIN_SIDE_PX:
        scores = lpips(metrics.shown_within(pair.image, pair.reference, pair.mask), pair.reference)
        figures[f"lpips_vgg{suffix}"], figures[f"lpips_vgg_01{suffix}"] = (
            scores.lpips_vgg,
            scores.lpips_vgg_01,
        )
    return figures


def _count_visibility(
    visibility: Float[np.ndarray, "h w"] | None,
    gathered: _Gathered,
    maps: Mapping[str, np.ndarray],
    mask: Bool[np.ndarray, "h w"] | None,
) -> float | None:
    """Pool the pixels by V; the mean V of what the view sees, None where nothing is known."""
    if visibility is None or gathered.histogram is None:
        return None
    gathered.histogram.add(visibility, maps, mask)
    seen = ~np.isnan(visibility) if mask is None else mask & ~np.isnan(visibility)
    return float(visibility[seen].mean(dtype=np.float64)) if seen.any() else None


def _seen(view: View, model: MeasuredModel, mask: Bool[np.ndarray, "h w"] | None) -> Bool[np.ndarray, "h w"] | None:
    """The seen pixels of a view, of those that its mask keeps."""
    if model.seen_map is None:
        return None
    seen = np.asarray(model.seen_map(view.camera))
    return seen if mask is None else seen & mask


def _depth_figures(
    view: View, model: MeasuredModel, seen: Bool[np.ndarray, "h w"] | None, gathered: _Gathered
) -> dict[str, float | None]:
    """How far the model's depth is from the truth in this view, which is also pooled; None without a truth."""
    if model.true_depth is None or model.render_depth is None or model.camera_height is None or seen is None:
        return figures_of({})
    with torch.inference_mode():
        drawn = model.render_depth(view.camera)
    found = errors_of_view(drawn, np.asarray(model.true_depth(view)), seen, model.camera_height)
    own = {kind: DepthErrors() for kind in found}
    for kind, errors in found.items():
        own[kind].add(errors)
        gathered.depth_errors.setdefault(kind, DepthErrors()).add(errors)
    return figures_of(own)


def _largest_splats(view: View, model: MeasuredModel) -> int | None:
    """How many of the splats of a view are larger than its picture."""
    if model.splats_of is None:
        return None
    with torch.inference_mode():
        return larger_than_picture(model.splats_of(view.camera), view.camera.width, view.camera.height)


def _draw(
    view: View,
    stem: str,
    on_sheet: bool,
    raw: _Pair,
    row: Mapping[str, Any],
    inputs: _Inputs,
    gathered: _Gathered,
) -> None:
    if inputs.settings.comparisons:
        picture = pictures.comparison(
            raw.reference, raw.image, view.name, f"{row['psnr']:.2f} dB   SSIM {row['ssim']:.3f}",
            raw.mask, inputs.settings.error_limit,
        )  # fmt: skip
        saving.write_png(inputs.output / "comparisons" / f"{stem}.png", np.asarray(picture))
    if on_sheet:
        small = pictures.thumbnail(raw.reference), pictures.thumbnail(raw.image)
        gathered.cells.append(pictures.Thumbnail(view.name, f"{row['psnr']:.2f} dB", *small))


def _summary(
    gathered: _Gathered, model: MeasuredModel, lpips_note: str, settings: EvaluationSettings
) -> dict[str, Any]:
    rows = gathered.rows
    means = {name: mean_or_none([row[name] for row in rows]) for name in RAW + CORRECTED + AFFINE}
    pixel_bins = gathered.histogram.bins(settings.visibility_bins) if gathered.histogram else None
    visible = [np.nan if row["mean_visibility"] is None else row["mean_visibility"] for row in rows]
    figures = [{name: row[name] for name in RAW + CORRECTED + AFFINE} for row in rows]
    unfitted = sum(row.get("colour_fitted") is False for row in rows)
    notes = [lpips_note] if lpips_note else []
    if unfitted:
        notes.append(f"colour correction: too few unsaturated pixels in {unfitted} views, left as they are")
    result = {
        **means,
        "by_visibility": pixel_bins,
        "views_by_visibility": view_bins(visible, figures, settings.visibility_bins) if pixel_bins else None,
        **solidity_of_all(rows),
        **figures_of(gathered.depth_errors),
        **largest_splats_of_all(rows),
        **asdict(model.facts),
        "fps": 1.0 / max(statistics.median(gathered.seconds), 1e-9) if model.timed else None,
        settings.title.replace(" ", "_"): len(rows),
        "notes": notes,
    }
    return jsonable(result)


def _write(output: Path, result: Mapping[str, Any], gathered: _Gathered, title: str) -> None:
    if gathered.cells:
        count = len(gathered.rows)
        shown = f"{len(gathered.cells)} of {count}" if len(gathered.cells) < count else f"{count}"
        psnr = "PSNR –" if result["psnr"] is None else f"PSNR {result['psnr']:.2f} dB"
        ssim = "SSIM –" if result["ssim"] is None else f"SSIM {result['ssim']:.3f}"
        sheet = pictures.contact_sheet(gathered.cells, f"{shown} {title} · {psnr} · {ssim}")
        saving.write_png(output / "contact_sheet.png", np.asarray(sheet))
    write_json(output / "per_view.json", jsonable(gathered.rows))
    write_json(output / "metrics.json", result)  # last: where it stands, the rest is complete
