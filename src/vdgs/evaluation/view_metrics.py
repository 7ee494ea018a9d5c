"""Measures one view of a model: its figures, its images, and what it adds to figures over all views.

`view_metrics_io` saves the result of a view, so that several processes may measure views: figures over all views are
gathered in the order of the views, and have the same bits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from vdgs.captures.capture import View
from vdgs.errors import CaptureError, TrainingDiverged
from vdgs.evaluation import comparison_images, metrics
from vdgs.evaluation.by_block import MIN_ALPHA
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.color_correction import correct_colors, correct_colors_affine
from vdgs.evaluation.depth_errors import (
    WITHIN_THRESHOLD,
    DepthErrors,
    compute_depth_errors,
    summarize_depth_errors,
)
from vdgs.evaluation.lpips import MIN_SIDE_PX, Lpips
from vdgs.evaluation.opacity_coverage import RenderedImage, count_oversized_splats, measure_opacity_coverage
from vdgs.evaluation.renderable_model import EvaluationSettings, ReferenceViews, RenderableModel, RenderedView
from vdgs.evaluation.splat_artifacts import floater_share, needle_share, training_view_angles
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.system.documents import JsonObject

RAW_KEYS = ("psnr", "ssim", "lpips_vgg", "lpips_vgg_01")
CORRECTED_KEYS = tuple(f"{name}_cc" for name in RAW_KEYS)
#: After one affine map of the colors, which is fitted on the view too.
AFFINE_KEYS = ("psnr_affine", "ssim_affine")
#: In neutral colors, where the other figures are of an exposed picture.
REFERENCE_EXPOSURE_KEYS = ("psnr_reference_exposure", "ssim_reference_exposure")


@dataclass(frozen=True, eq=False)
class ViewInputs:
    """What views are measured with."""

    reference_views: ReferenceViews
    model: RenderableModel
    lpips: Lpips | None
    settings: EvaluationSettings
    output: Path

    @cached_property
    def stems(self) -> list[str]:
        """The names of the files of each view."""
        return comparison_images.unique_file_stems([view.name for view in self.reference_views.views])

    @cached_property
    def on_sheet(self) -> set[int]:
        """The views that the contact sheet shows: an even choice of all."""
        count = len(self.reference_views.views)
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
    by_angle: VisibilityHistogram | None = None
    """Of its pixels by the angle to the nearest training view; None where that is not known."""
    cell: comparison_images.Thumbnail | None = None
    """What the contact sheet shows of it, if it does."""


def measure_view(index: int, inputs: ViewInputs) -> ViewMetrics:
    """Render and measure one of the views, write its pictures; what it comes to.

    Raises CaptureError where its photograph or mask does not fit its camera, TrainingDiverged where the render is not
    finite.
    """
    view, stem, settings = inputs.reference_views.views[index], inputs.stems[index], inputs.settings
    reference, mask = _load_reference(view, inputs.reference_views)
    covered = _covered(view, inputs.model, mask)
    if settings.covered_only:
        mask = covered
    plain, seconds = _render(view, inputs.model, inputs.model.render)
    exposure = None if inputs.model.exposure is None else inputs.model.exposure(view)
    rendered = plain if exposure is None else plain.with_exposure(exposure)
    image = metrics.to_8bit(rendered.image)
    comparison_images.write_png(inputs.output / "renders" / f"{stem}.png", image)
    figures, maps = _compare(image, reference, mask, "")
    row: JsonObject = {
        "name": view.name,
        "render": f"renders/{stem}.png",
        "alpha": _write_alpha(inputs.output, stem, rendered),
        **figures,
        **_lpips(image, reference, mask, "", inputs.lpips),
        **dict.fromkeys(REFERENCE_EXPOSURE_KEYS),
        "exposure": None if exposure is None else exposure.tolist(),
        **dict.fromkeys((*CORRECTED_KEYS, *AFFINE_KEYS)),
    }
    if exposure is not None:
        neutral = plain
        if inputs.model.render_neutral is not None:
            neutral, seconds = _render(view, inputs.model, inputs.model.render_neutral)
        row |= _compare(metrics.to_8bit(neutral.image), reference, mask, "_reference_exposure")[0]
    if settings.color_correction:
        correction = correct_colors(image, reference, mask)
        row["color_correction_fitted"] = correction.fitted
        for suffix, corrected in (("_cc", correction), ("_affine", correct_colors_affine(image, reference, mask))):
            pixels = metrics.to_8bit(corrected.image)
            figures, corrected_maps = _compare(pixels, reference, mask, suffix)
            row |= figures
            maps |= corrected_maps
            if suffix == "_cc":
                row |= _lpips(pixels, reference, mask, suffix, inputs.lpips)
    visibility = None if inputs.model.visibility_map is None else np.asarray(inputs.model.visibility_map(view.camera))
    by_visibility, row["mean_visibility"] = _count_visibility(visibility, maps, mask)
    row |= measure_opacity_coverage(rendered, reference, covered)
    by_angle, depth_errors, figures = _measure_depths(view, inputs.model, maps, mask, covered)
    row |= summarize_depth_errors(depth_errors) | figures | _splat_figures(view, inputs.model)
    row["unmasked_pixels"] = image.shape[0] * image.shape[1] if mask is None else int(mask.sum())
    row["render_seconds"] = seconds
    if settings.comparisons:
        drawn = comparison_images.draw_comparison(
            reference, image, view.name, f"{row['psnr']:.2f} dB   SSIM {row['ssim']:.3f}", mask, settings.error_limit
        )
        comparison_images.write_png(inputs.output / "comparisons" / f"{stem}.png", np.asarray(drawn))
    cell = None
    if index in inputs.on_sheet:
        small = comparison_images.make_thumbnail(reference), comparison_images.make_thumbnail(image)
        cell = comparison_images.Thumbnail(view.name, f"{row['psnr']:.2f} dB", *small)
    return ViewMetrics(row, by_visibility, depth_errors, by_angle, cell)


def _covered(
    view: View, model: RenderableModel, mask: Bool[np.ndarray, "h w"] | None
) -> Bool[np.ndarray, "h w"] | None:
    """The pixels that enough training cameras see; None where that is not known."""
    if model.coverage_map is None:
        return None
    covered = np.asarray(model.coverage_map(view.camera))
    return covered if mask is None else covered & mask


def _load_reference(
    view: View, reference_views: ReferenceViews
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
    reference, mask = reference_views.load_image(view), reference_views.load_mask(view)
    expected = (view.camera.height, view.camera.width)
    for what, shape in (("photograph", reference.shape[:2]), ("mask", expected if mask is None else mask.shape)):
        if shape != expected:
            raise CaptureError(
                f"{view.image_path}: the {what} of {view.name} is {shape[1]} x {shape[0]} pixels, its camera "
                f"{expected[1]} x {expected[0]}. Use images of the size that the camera describes."
            )
    return reference, mask


def _render(view: View, model: RenderableModel, draw: Callable[[Camera], RenderedView]) -> tuple[RenderedImage, float]:
    """A render of the model and the seconds it took, the GPU's work included."""
    with torch.inference_mode():
        _wait_for_gpu()
        start = time.perf_counter()
        rendered = draw(view.camera)
        _wait_for_gpu()
        seconds = time.perf_counter() - start
        image, alpha = (
            None if each is None else torch.as_tensor(each, device="cpu").detach().float().numpy()
            for each in (rendered.image, getattr(rendered, "alpha", None))
        )
    assert image is not None
    if image.shape != (view.camera.height, view.camera.width, 3):
        raise ValueError(f"the render of {view.name} has shape {list(image.shape)}")
    if not np.isfinite(image).all():
        raise TrainingDiverged(
            f"the render of {view.name} holds values that are not finite numbers: the model is damaged. "
            "Evaluate an earlier state, or train again with lower rates."
        )
    behind = None if model.background_image is None else model.background_image(view.camera)
    return RenderedImage(image, alpha, model.background if behind is None else behind.cpu().numpy()), seconds


def _write_alpha(output: Path, stem: str, rendered: RenderedImage) -> str | None:
    """Write the picture of alpha, if it is known; its name in the output folder."""
    if rendered.alpha is None:
        return None
    name = f"alpha/{stem}.png"
    comparison_images.write_png(output / name, np.repeat(metrics.to_8bit(rendered.alpha)[..., None], 3, axis=2))
    return name


def _wait_for_gpu() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _compare(
    image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None,
    suffix: str,
) -> tuple[dict[str, float | None], dict[str, Float[np.ndarray, "h w"]]]:  # fmt: skip
    """PSNR and SSIM of an image, and the maps of squared error and SSIM that they are means of."""
    errors, ssim = metrics.squared_error(image, reference), metrics.ssim_map(image, reference, mask)
    figures: dict[str, float | None] = {
        f"psnr{suffix}": metrics.psnr_from_mse(metrics.masked_mean(errors, mask)),
        f"ssim{suffix}": metrics.masked_mean(ssim, mask),
    }
    return figures, {f"squared_error{suffix}": errors, f"ssim{suffix}": ssim}


def _lpips(
    image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None,
    suffix: str, lpips: Lpips | None,
) -> dict[str, float | None]:  # fmt: skip
    """Both LPIPS; None without weights, or where the image is too small or masked as a whole."""
    scores = None
    if lpips is not None and (mask is None or mask.any()) and min(image.shape[:2]) >= MIN_SIDE_PX:
        scores = lpips(metrics.replace_masked(image, reference, mask), reference)
    return {f"{name}{suffix}": None if scores is None else getattr(scores, name) for name in RAW_KEYS[2:]}


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


def _measure_depths(
    view: View, model: RenderableModel, maps: Mapping[str, np.ndarray], mask: Bool[np.ndarray, "h w"] | None,
    covered: Bool[np.ndarray, "h w"] | None,
) -> tuple[VisibilityHistogram | None, dict[str, DepthErrors], dict[str, float | None]]:  # fmt: skip
    """The pixels pooled by the angle to the nearest training view; errors of the model's depth and the share of
    floaters, where there is a truth."""
    if model.render_depth is None or not (model.training_cameras or model.true_depth):
        return None, {}, {"floaters": None}
    with torch.inference_mode():
        raster = model.render_depth(view.camera)
    assert raster.median_depth is not None
    alpha, depth = (each.cpu().numpy() for each in (raster.alpha, raster.median_depth))
    result: dict[str, DepthErrors] = {}
    floaters, named, place = None, dict(maps), np.where(alpha > MIN_ALPHA, depth, np.inf)
    if model.true_depth is not None and model.camera_height is not None:
        truth = np.asarray(model.true_depth(view))
        place, floaters = truth, floater_share(depth, alpha, truth, model.camera_height)
        if covered is not None:
            result = _depth_errors(raster, truth, covered, model.camera_height)
            near = (alpha > MIN_ALPHA) & (np.abs(depth - truth) <= WITHIN_THRESHOLD * model.camera_height)
            named["depth_within_2_percent"] = near.astype(np.float64)
    by_angle = None
    if model.training_cameras:
        by_angle = VisibilityHistogram([*named])
        angles = training_view_angles(view.camera, place, model.training_cameras)
        known = np.isfinite(angles) if mask is None else np.isfinite(angles) & mask
        by_angle.add(angles, named, known)
    return by_angle, result, {"floaters": floaters}


def _depth_errors(
    raster: Raster, truth: Float[np.ndarray, "h w"], covered: Bool[np.ndarray, "h w"], camera_height: float
) -> dict[str, DepthErrors]:
    """How far the model's depth is from the truth in a view."""
    result: dict[str, DepthErrors] = {}
    for kind, values in compute_depth_errors(raster, truth, covered, camera_height).items():
        result[kind] = DepthErrors()
        result[kind].add(values)
    return result


def _splat_figures(view: View, model: RenderableModel) -> JsonObject:
    """How many of the splats of a view are larger than its picture, and the share that needles draw."""
    if model.decode_splats is None:
        return {"oversized_splats": None, "needles": None}
    with torch.inference_mode():
        splats = model.decode_splats(view.camera)
        count = count_oversized_splats(splats, view.camera.width, view.camera.height)
        return {"oversized_splats": count, "needles": needle_share(splats, view.camera)}
