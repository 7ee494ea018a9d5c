"""What a file of Gaussians loses against the model that it was made from: both drawn on the same test views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import View
from vdgs.evaluation.by_visibility import VisibilityBin, VisibilityHistogram
from vdgs.evaluation.color_correction import correct_colors
from vdgs.evaluation.evaluate_run import cached_reference_views, make_visibility_map, with_coarse_model
from vdgs.evaluation.metrics import masked_mean, psnr_from_mse, squared_error, ssim_map, to_8bit
from vdgs.evaluation.view_exposures import ViewExposures, apply_exposure_numpy, make_exposures
from vdgs.export.formats.export_scene import concatenate
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.gaussians import Gaussians, render_gaussians, visible_gaussian_rows
from vdgs.model.renderer import render
from vdgs.runs.open_run import OpenedRun

#: Groups of pixels by visibility.
VISIBILITY_BINS = 4
#: Views that are drawn at most, evenly taken: more would say the same.
MAX_VIEWS = 40


@dataclass(frozen=True, kw_only=True)
class ExportLoss:
    """Means over the views, of the model and of the file; `by_visibility` as in metrics.json, with both."""

    #: How many were drawn, and of how many.
    views: int
    views_available: int
    #: Which views: "test", or "training" where none is held out.
    of: str
    psnr: float
    psnr_baked: float
    #: After the usual correction of colors, fitted to each photograph: what is lost but for its exposure.
    psnr_cc: float
    psnr_cc_baked: float
    ssim: float
    ssim_baked: float
    by_visibility: list[VisibilityBin]


def views_to_measure(run: OpenedRun) -> list[View]:
    """The test views, or every tenth training view where there is none; at most `MAX_VIEWS`."""
    views = list(run.capture.test_views) or list(run.capture.train_views)[::10]
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(MAX_VIEWS, len(views))).astype(int))]


def measure_loss(
    run: OpenedRun, chunks: Iterable[Gaussians], after_view: Callable[[], None] = lambda: None
) -> ExportLoss:
    """Draw `views_to_measure` with the model and with Gaussians, which are in the ground frame, and compare both with
    the photographs, in 8 bits as all metrics. Files hold neutral colors: where exposures were fitted, both are compared
    as `vdgs eval` compares in the exposure of each view, or in neutral colors where these are of the local exposure
    (`AnchorModel.local_exposure`). Of the pieces only what those views show is kept in memory."""
    views = views_to_measure(run)
    exposure = file_exposure(run)
    gaussians = seen_gaussians(chunks, [view.camera for view in views])
    visibility = make_visibility_map(with_coarse_model(run))
    names = [f"{figure}{whose}" for figure in ("squared_error", "ssim") for whose in ("", "_baked")]
    histogram, rows = VisibilityHistogram(names), list[list[float]]()
    with cached_reference_views(views) as photographs:
        for view in views:
            reference, mask = photographs.load_image(view), photographs.load_mask(view)
            # Over the plain color: files have no environment map.
            own = render(run.model, view.camera, background=run.model.background).image.cpu().numpy()
            neutral = own, render_file(gaussians, run, view.camera).image.numpy()
            exposed = neutral if exposure is None else [apply_exposure_numpy(each, exposure(view)) for each in neutral]
            drawn = [to_8bit(each) for each in exposed]
            corrected = [to_8bit(correct_colors(picture, reference, mask).image) for picture in drawn]
            errors = [squared_error(picture, reference) for picture in (*drawn, *corrected)]
            likeness = [ssim_map(picture, reference, mask) for picture in drawn]
            histogram.add(visibility(view.camera), dict(zip(names, errors[:2] + likeness, strict=True)), mask)
            psnrs = [psnr_from_mse(masked_mean(error, mask)) for error in errors]
            rows.append([*psnrs, *(masked_mean(each, mask) for each in likeness)])
            after_view()
    tested = run.capture.test_views
    there_are, of = (len(tested), "test") if tested else (len(run.capture.train_views), "training")
    psnr, psnr_baked, psnr_cc, psnr_cc_baked, ssim, ssim_baked = np.mean(rows, axis=0).tolist()
    return ExportLoss(
        views=len(views), views_available=there_are, of=of, psnr=psnr, psnr_baked=psnr_baked, psnr_cc=psnr_cc,
        psnr_cc_baked=psnr_cc_baked, ssim=ssim, ssim_baked=ssim_baked,
        by_visibility=[dict(each) for each in histogram.bins(VISIBILITY_BINS)],
    )  # fmt: skip


def seen_gaussians(pieces: Iterable[Gaussians], cameras: Sequence[Camera]) -> Gaussians:
    """What the cameras may show of the pieces, and at least one Gaussian."""
    kept: list[Gaussians] = []
    for piece in pieces:
        seen = torch.zeros(len(piece), dtype=torch.bool, device="cpu")
        seen[:1] = not kept
        for camera in cameras:
            seen[visible_gaussian_rows(piece, camera)] = True
        kept.append(piece.select(seen))
    return concatenate(kept)


def file_exposure(run: OpenedRun) -> ViewExposures | None:
    """The exposures that files, which hold neutral colors, are drawn in to be compared with photographs; None where
    neutral colors are those of the local exposure."""
    return make_exposures(run.model, run.capture) if run.model.local_exposure is None else None


@torch.no_grad()
def render_file(gaussians: Gaussians, run: OpenedRun, camera: Camera) -> Raster:
    """What a file shows, on the CPU, over the plain color of its run."""
    background: Float[Tensor, "3"] = torch.tensor(run.model.background, dtype=torch.float32, device="cpu")
    seen = gaussians.select(visible_gaussian_rows(gaussians, camera))
    return render_gaussians(seen, camera, background, seen.sh_degree)[0]
