"""Where few photographs look, is it depth that is wrong? Errors of a run's test views by true V and by error of depth.

    python -m experiments.reports.analyses.depth_by_v RUN [--model coarse]

Needs a generated capture with its truth. For quarters of the pixels by V: the median error of median depth, relative to
the true one, the share of pixels beyond 3 %, their part of all squared error, and PSNR of those within 1 % and of all.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from experiments.microbench.machine import describe
from experiments.reports.analyses.ceiling import picture, psnr

from vdgs.model.render import render
from vdgs.runs.opening import open_run
from vdgs.synth.truth import load_truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--model", choices=("coarse", "merged"), default="merged")
    asked = parser.parse_args()
    run = open_run(asked.run, asked.model)
    truth, scale = load_truth(run.capture.root), run.capture.ground.scale
    errors, wrong, seen = [], [], []
    for view in run.capture.test_views:
        with torch.inference_mode():
            drawn = render(run.model, view.camera, depth=True)
        true = scale * truth.depth_map(view)
        shown = (drawn.image.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy().astype(np.float32)
        errors.append(((shown - picture(view)) ** 2).mean(-1).ravel())
        wrong.append((np.abs(drawn.median_depth.numpy() - true) / true).ravel())
        seen.append(truth.visibility_map(view).ravel())
    squared, off, views = (np.concatenate(each) for each in (errors, wrong, seen))
    known = np.isfinite(off) & (np.nan_to_num(views) >= 1)
    ends = np.quantile(views[known], (0, 0.25, 0.5, 0.75, 1))
    print(describe())
    print(f"{'V':>12} {'median':>8} {'beyond 3 %':>11} {'of error':>9} {'within 1 %':>11} {'all':>7}")
    for index, (low, high) in enumerate(pairwise(ends)):
        group = known & (views <= high) & ((views >= low) if index == 0 else (views > low))
        far, near = group & (off > 0.03), group & (off < 0.01)
        print(
            f"{low if index == 0 else low + 1:>5.0f} to {high:<4.0f} {np.median(off[group]):>8.2%} "
            f"{far.sum() / group.sum():>11.0%} {squared[far].sum() / squared[group].sum():>9.0%} "
            f"{psnr(squared[near]):>8.2f} dB {psnr(squared[group]):>7.2f} dB"
        )


if __name__ == "__main__":
    main()
