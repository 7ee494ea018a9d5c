"""One view of a model measured: its figures, its pictures, and what it adds to figures over all views.

What a view comes to can be kept in a file (`records`), so that views may be measured by several processes: figures over
all views are gathered from them in their order, and have the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vdgs.captures.capture import View
from vdgs.errors import CaptureError, TrainingDiverged
from vdgs.evaluation import comparison_images, image_io, metrics
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.color_correction import correct_colors, correct_colors_affine
from vdgs.evaluation.depth_errors import DepthErrors, compute_depth_errors, summarize_depth_errors
from vdgs.evaluation.lpips import MIN_SIDE_PX, Lpips
from vdgs.evaluation.opacity_coverage import RenderedImage, count_oversized_splats, measure_opacity_coverage
from vdgs.evaluation.renderable_model import EvaluationSettings, ReferenceViews, RenderableModel
from vdgs.system.documents import JsonObject

RAW_KEYS = ("psnr", "ssim", "lpips_vgg", "lpips_vgg_01")
CORRECTED_KEYS = tuple(f"{name}_cc" for name in RAW_KEYS)
#: After one affine map of the colours, which is fitted on the view too.
AFFINE_KEYS = ("psnr_affine", "ssim_affine")
#: In neutral colours, where the other figures are of an exposed picture.
REFERENCE_EXPOSURE_KEYS = ("psnr_reference_exposure", "ssim_reference_exposure")


@dataclass(frozen=True, eq=False)
class ViewInputs:
    """What views are measured with."""

    photographs: ReferenceViews
    model: RenderableModel
    lpips: Lpips | None
    settings: EvaluationSettings
    output: Path

    @cached_property
    def stems(self) -> list[str]:
        """The names of the files of each view."""
        return image_io.unique_file_stems([view.name for view in self.photographs.views])

    @cached_property
    def on_sheet(self) -> set[int]:
        """The views that the contact sheet shows: an even choice of all."""
        count = len(self.photographs.views)
        return set(
            np.linspace(0, count - 1, min(count, self.settings.contact_sheet_views)).round().astype(int).tolist()
        )


@dataclass(frozen=True, eq=False)
class ViewMetrics:
    """What a view comes to."""

    row: JsonObject
    """Its figures, plain values: an entry of per_view.json."""
    by_visibility: VisibilityHistogram | None = None
    """Of its pixels alone; None where V is not known."""
    depth_errors: dict[str, DepthErrors] = field(default_factory=dict)
    """By kind, of its pixels alone."""
    cell: comparison_images.Thumbnail | None = None
    """What the contact sheet shows of it, if it does."""


@dataclass(frozen=True, eq=False)
class _ImagePair:
    """A render (8 bits) against its photograph, and the mask of what counts."""

    image: UInt8[np.ndarray, "h w 3"]
    reference: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"] | None


def measure_view(index: int, inputs: ViewInputs) -> ViewMetrics:
    """Render and measure one of the views, write its pictures; what it comes to.

    Raises CaptureError where its photograph or mask does not fit its camera, TrainingDiverged where the render is not
    finite.
    """
    view, stem, settings = inputs.photographs.views[index], inputs.stems[index], inputs.settings
    reference, mask = _load_reference(view, inputs.photographs)
    neutral, seconds = _rendered(view, inputs.model)
    exposure = None if inputs.model.exposure is None else inputs.model.exposure(view)
    rendered = neutral if exposure is None else neutral.with_exposure(exposure)
    image = metrics.to_8bit(rendered.image)
    image_io.write_png(inputs.output / "renders" / f"{stem}.png", image)
    raw = _ImagePair(image, reference, mask)
    maps = _maps(raw, "")
    row: JsonObject = {
        "name": view.name,
        "render": f"renders/{stem}.png",
        "alpha": _write_alpha(inputs.output, stem, rendered),
        **_metrics(raw, maps, "", inputs.lpips),
        **_reference_exposure_metrics(
            None if exposure is None else _ImagePair(metrics.to_8bit(neutral.image), reference, mask)
        ),
        "exposure": None if exposure is None else exposure.tolist(),
    }
    if settings.color_correction:
        correction = correct_colors(image, reference, mask)
        corrected = _ImagePair(metrics.to_8bit(correction.image), reference, mask)
        corrected_maps = _maps(corrected, "_cc")
        row |= _metrics(corrected, corrected_maps, "_cc", inputs.lpips)
        row["color_correction_fitted"] = correction.fitted
        affine = _ImagePair(metrics.to_8bit(correct_colors_affine(image, reference, mask).image), reference, mask)
        affine_maps = _maps(affine, "_affine")
        row |= _metrics_without_lpips(affine, affine_maps, "_affine")
        maps |= corrected_maps | affine_maps
    else:
        row |= dict.fromkeys((*CORRECTED_KEYS, *AFFINE_KEYS))
    visibility = None if inputs.model.visibility_map is None else np.asarray(inputs.model.visibility_map(view.camera))
    by_visibility, row["mean_visibility"] = _count_visibility(visibility, maps, mask)
    seen = _covered(view, inputs.model, mask)
    row |= measure_opacity_coverage(rendered, reference, seen)
    depth_errors = _depth_errors(view, inputs.model, seen)
    row |= summarize_depth_errors(depth_errors)
    row["oversized_splats"] = _oversized_splats(view, inputs.model)
    row["unmasked_pixels"] = image.shape[0] * image.shape[1] if mask is None else int(mask.sum())
    row["render_seconds"] = seconds
    _draw_comparison(view, stem, raw, row, inputs)
    cell = None
    if index in inputs.on_sheet:
        small = comparison_images.make_thumbnail(raw.reference), comparison_images.make_thumbnail(raw.image)
        cell = comparison_images.Thumbnail(view.name, f"{row['psnr']:.2f} dB", *small)
    return ViewMetrics(row, by_visibility, depth_errors, cell)


def _load_reference(
    view: View, photographs: ReferenceViews
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
    reference, mask = photographs.load_image(view), photographs.load_mask(view)
    wanted = (view.camera.height, view.camera.width)
    for what, shape in (("photograph", reference.shape[:2]), ("mask", wanted if mask is None else mask.shape)):
        if shape != wanted:
            raise CaptureError(
                f"{view.image_path}: the {what} of {view.name} is {shape[1]} x {shape[0]} pixels, its camera "
                f"{wanted[1]} x {wanted[0]}. Use images of the size that the camera describes."
            )
    return reference, mask


def _rendered(view: View, model: RenderableModel) -> tuple[RenderedImage, float]:
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
    return RenderedImage(pixels, None if alpha is None else _on_cpu(alpha), model.background), seconds


def _on_cpu(values: Tensor) -> np.ndarray:
    pixels: np.ndarray = torch.as_tensor(values).detach().to("cpu", torch.float32).numpy()
    return pixels


def _write_alpha(output: Path, stem: str, rendered: RenderedImage) -> str | None:
    """Write the picture of alpha, if it is known; its name in the output folder."""
    if rendered.alpha is None:
        return None
    name = f"alpha/{stem}.png"
    image_io.write_png(output / name, np.repeat(metrics.to_8bit(rendered.alpha)[..., None], 3, axis=2))
    return name


def _wait_for_gpu() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _maps(pair: _ImagePair, suffix: str) -> dict[str, Float[np.ndarray, "h w"]]:
    return {
        f"squared_error{suffix}": metrics.squared_error(pair.image, pair.reference),
        f"ssim{suffix}": metrics.ssim_map(pair.image, pair.reference, pair.mask),
    }


def _metrics(
    pair: _ImagePair, maps: Mapping[str, np.ndarray], suffix: str, lpips: Lpips | None
) -> dict[str, float | None]:
    """The four figures of a pair; LPIPS is None without weights or where the image is too small for it."""
    figures: dict[str, float | None] = {
        f"psnr{suffix}": metrics.psnr_from_mse(metrics.masked_mean(maps[f"squared_error{suffix}"], pair.mask)),
        f"ssim{suffix}": metrics.masked_mean(maps[f"ssim{suffix}"], pair.mask),
        f"lpips_vgg{suffix}": None,
        f"lpips_vgg_01{suffix}": None,
    }
    nothing_kept = pair.mask is not None and not pair.mask.any()
    if lpips is not None and not nothing_kept and min(pair.image.shape[:2]) >= MIN_SIDE_PX:
        scores = lpips(metrics.replace_masked(pair.image, pair.reference, pair.mask), pair.reference)
        figures[f"lpips_vgg{suffix}"], figures[f"lpips_vgg_01{suffix}"] = (scores.lpips_vgg, scores.lpips_vgg_01)
    return figures


def _metrics_without_lpips(pair: _ImagePair, maps: Mapping[str, np.ndarray], suffix: str) -> dict[str, float | None]:
    """PSNR and SSIM of a pair."""
    figures = _metrics(pair, maps, suffix, None)
    return {name: figures[name] for name in (f"psnr{suffix}", f"ssim{suffix}")}


def _reference_exposure_metrics(neutral: _ImagePair | None) -> dict[str, float | None]:
    """What the picture in neutral colours comes to; None where that is the picture which is measured anyway."""
    if neutral is None:
        return dict.fromkeys(REFERENCE_EXPOSURE_KEYS)
    return _metrics_without_lpips(neutral, _maps(neutral, "_reference_exposure"), "_reference_exposure")


def _count_visibility(
    visibility: Float[np.ndarray, "h w"] | None, maps: Mapping[str, np.ndarray], mask: Bool[np.ndarray, "h w"] | None
) -> tuple[VisibilityHistogram | None, float | None]:
    """The pixels pooled by V, and the mean V of what the view sees; None where nothing is known."""
    if visibility is None:
        return None, None
    histogram = VisibilityHistogram([*maps])
    histogram.add(visibility, maps, mask)
    seen = ~np.isnan(visibility) if mask is None else mask & ~np.isnan(visibility)
    return histogram, float(visibility[seen].mean(dtype=np.float64)) if seen.any() else None


def _covered(
    view: View, model: RenderableModel, mask: Bool[np.ndarray, "h w"] | None
) -> Bool[np.ndarray, "h w"] | None:
    """The seen pixels of a view, of those that its mask keeps."""
    if model.coverage_map is None:
        return None
    seen = np.asarray(model.coverage_map(view.camera))
    return seen if mask is None else seen & mask


def _depth_errors(view: View, model: RenderableModel, seen: Bool[np.ndarray, "h w"] | None) -> dict[str, DepthErrors]:
    """How far the model's depth is from the truth in this view; nothing without a truth."""
    if model.true_depth is None or model.render_depth is None or model.camera_height is None or seen is None:
        return {}
    with torch.inference_mode():
        drawn = model.render_depth(view.camera)
    found = compute_depth_errors(drawn, np.asarray(model.true_depth(view)), seen, model.camera_height)
    own = {kind: DepthErrors() for kind in found}
    for kind, errors in found.items():
        own[kind].add(errors)
    return own


def _oversized_splats(view: View, model: RenderableModel) -> int | None:
    """How many of the splats of a view are larger than its picture."""
    if model.decode_splats is None:
        return None
    with torch.inference_mode():
        return count_oversized_splats(model.decode_splats(view.camera), view.camera.width, view.camera.height)


def _draw_comparison(view: View, stem: str, raw: _ImagePair, row: Mapping[str, Any], inputs: ViewInputs) -> None:
    if not inputs.settings.comparisons:
        return
    picture = comparison_images.draw_comparison(
        raw.reference, raw.image, view.name, f"{row['psnr']:.2f} dB   SSIM {row['ssim']:.3f}",
        raw.mask, inputs.settings.error_limit,
    )  # fmt: skip
    image_io.write_png(inputs.output / "comparisons" / f"{stem}.png", np.asarray(picture))
