"""Neutral colors of a run by how far photographs count for the exposure of a place (`model.local_exposure.REACH`).

    python -m experiments.reports.analyses.local_exposures RUN [--reach 3 4 ...]

RUN was trained with --exposure-compensation and --validation, whose views are measured. Prints PSNR and SSIM with one
exposure for the whole scene, and with that of each place.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from experiments.microbench.hardware_info import describe
from vdgs.captures.image_cache import ImageCache
from vdgs.evaluation import metrics
from vdgs.model.local_exposure import REACH, fit_local_exposure
from vdgs.model.renderer import Drawable, render
from vdgs.runs.open_run import OpenedRun, open_run
from vdgs.training import exposure_centering


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--reach", type=float, nargs="+", default=[REACH])
    asked = parser.parse_args()
    print(describe())
    run = open_run(asked.run)
    model = run.model.without_local_exposure()
    print(f"one for all: {measured(run, model)}")
    cameras = [view.camera for view in run.capture.train_views]
    for reach in asked.reach:
        with patch.object(exposure_centering, "fit_local_exposure", partial(fit_local_exposure, reach=reach)):
            local = exposure_centering.with_local_exposure(replace(model), cameras)
        print(f"reach {reach:g}: {measured(run, local)}")


def measured(run: OpenedRun, model: Drawable) -> str:
    """Means over the held-out views, all pixels."""
    found = []
    with ImageCache(run.capture.test_views, 0) as images:
        for index in range(len(run.capture.test_views)):
            drawn = metrics.to_8bit(render(model, images.camera(index)).image.cpu().numpy())
            photograph = images.get(index).image.numpy()
            error = metrics.masked_mean(metrics.squared_error(drawn, photograph), None)
            likeness = metrics.masked_mean(metrics.ssim_map(drawn, photograph, None), None)
            found.append((metrics.psnr_from_mse(error), likeness))
    psnr, ssim = np.mean(found, axis=0)
    return f"{psnr:.2f} dB, {ssim:.4f}"


if __name__ == "__main__":
    main()
