"""What a file of Gaussians loses against the model that it was made from: both drawn on the same test views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.evaluation.by_visibility import VisibilityHistogram
from vdgs.evaluation.metrics import masked_mean, psnr_of, squared_error, ssim_map, to_8bit
from vdgs.evaluation.of_run import cached_photographs, coarse_of, visibility_map
from vdgs.model.gaussians import Gaussians, draw_gaussians, visible_rows
from vdgs.model.render import render
from vdgs.runs.opening import TrainedRun

#: Groups of pixels by visibility.
BINS = 4


@dataclass(frozen=True)
class Loss:
    """Means over the views, of the model and of the file; `by_visibility` as in metrics.json, with both."""

    views: int
    #: Which views: "test", or "training" where none is held out.
    of: str
    psnr: float
    psnr_baked: float
    ssim: float
    ssim_baked: float
    by_visibility: list[dict[str, Any]]


def loss_of(run: TrainedRun, gaussians: Gaussians, after_view: Callable[[], None] = lambda: None) -> Loss:
    """Draw every test view (at most every tenth training view where there is none) with the model and with the
    Gaussians, which are in the ground frame, and compare both with the photograph, in 8 bits as all metrics."""
    views = list(run.capture.test_views) or list(run.capture.train_views)[::10]
    visibility = visibility_map(coarse_of(run))
    names = [f"{figure}{whose}" for figure in ("squared_error", "ssim") for whose in ("", "_baked")]
    histogram, rows = VisibilityHistogram(names), list[list[float]]()
    with cached_photographs(views) as photographs:
        for view in views:
            reference, mask = photographs.load_image(view), photographs.load_mask(view)
            drawn = to_8bit(render(run.model, view.camera).image.cpu().numpy()), _picture(gaussians, run, view.camera)
            errors = [squared_error(picture, reference) for picture in drawn]
            likeness = [ssim_map(picture, reference, mask) for picture in drawn]
            histogram.add(visibility(view.camera), dict(zip(names, errors + likeness, strict=True)), mask)
            psnrs = [psnr_of(masked_mean(error, mask)) for error in errors]
            rows.append([*psnrs, *(masked_mean(each, mask) for each in likeness)])
            after_view()
    psnr, psnr_baked, ssim, ssim_baked = np.mean(rows, axis=0).tolist()
    of = "test" if run.capture.test_views else "training"
    return Loss(len(views), of, psnr, psnr_baked, ssim, ssim_baked, [dict(each) for each in histogram.bins(BINS)])


@torch.no_grad()
def _picture(gaussians: Gaussians, run: TrainedRun, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    background: Float[Tensor, "3"] = torch.tensor(run.model.background)
    seen = gaussians.select(visible_rows(gaussians, camera))
    raster, _ = draw_gaussians(seen, camera, background, seen.degree)
    return to_8bit(raster.image.numpy())
