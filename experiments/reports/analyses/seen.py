"""How well a run of a generated capture tells which pixels of test views at least three training cameras see.

    vdgs synth town --truth
    vdgs run town --preset laptop --blocks 4 --output run
    python -m experiments.reports.analyses.seen run

A pixel's place is where the coarse model is half opaque; pixels less opaque than a limit continue the depth of the
nearest others (`evaluation.opacity_coverage`). Printed by limit: pixels taken for seen that are not, and the other way round,
both by true depth, of all pixels and of those that are open (alpha below 0.95), which decide how solid
a scene is said to be.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch

from experiments.microbench.hardware_info import describe
from vdgs.evaluation.evaluate_run import make_true_depth
from vdgs.evaluation.opacity_coverage import MIN_SEEN_BY, OPAQUE_ALPHA, fill_depth
from vdgs.geometry.camera import Camera
from vdgs.model.ground import below_horizon
from vdgs.model.renderer import render
from vdgs.runs.open_run import open_run
from vdgs.visibility.visibility_counts import count_visibility

LIMITS = (0.5, 0.8, OPAQUE_ALPHA, 0.99)


def main(path: Path) -> None:
    run = open_run(path, "coarse")
    cameras, views = [view.camera for view in run.capture.train_views], run.capture.test_views
    truth = make_true_depth(run.capture, views)
    if truth is None:
        sys.exit(f"{run.capture.root}: holds no true depth: write it with vdgs synth --truth")

    def held(camera: Camera, depth: np.ndarray) -> np.ndarray:
        places = torch.from_numpy(camera.unproject(depth).reshape(-1, 3))
        return count_visibility(places, cameras).numpy().reshape(depth.shape) >= MIN_SEEN_BY

    counts = defaultdict(lambda: np.zeros(4, int))
    for view in views:
        with torch.inference_mode():
            raster = render(run.model, view.camera, depth=True)
        alpha, median, true = raster.alpha.numpy(), raster.median_depth.numpy(), np.asarray(truth(view))
        ground = np.isfinite(true)
        seen_truly = held(view.camera, np.where(ground, true, 1.0))
        for limit in LIMITS:
            drawn = alpha >= limit
            seen = held(view.camera, fill_depth(median, drawn)) & (drawn | below_horizon(view.camera, *drawn.shape))
            for name, of in (("all", ground), ("open", ground & (alpha < OPAQUE_ALPHA))):
                pairs = (of, of & seen_truly, of & seen & ~seen_truly, of & ~seen & seen_truly)
                counts[limit, name] += [each.sum() for each in pairs]
    print(describe())
    print(f"{'limit':>6} {'pixels':>6} {'number':>9} {'truly seen':>11} {'falsely seen':>13} {'falsely unseen':>15}")
    for (limit, name), (number, seen, wrongly, missed) in sorted(counts.items(), key=lambda each: each[0][::-1]):
        print(f"{limit:>6} {name:>6} {number:>9} {seen:>11} {wrongly:>13} {missed:>15}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
