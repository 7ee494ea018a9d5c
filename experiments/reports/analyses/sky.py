"""What a scene shows of sky, of land near and far: PSNR and what hangs before the sky, of runs of one generated flight.

    python -m experiments.reports.analyses.sky RUN [RUN ...] [--pictures OUT.png]

Needs a generated capture with its truth (`vdgs synth CAPTURE --flight horizon --truth`). Views are the validation
photographs and the off-path views for validation.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from vdgs.captures.capture import View
from vdgs.captures.ground_truth import load_ground_truth
from vdgs.captures.loading import load_capture
from vdgs.captures.off_path import OFF_PATH_FOLDER, off_path_set
from vdgs.config.capture_options import CaptureOptions
from vdgs.evaluation.metrics import to_8bit
from vdgs.model.renderer import render
from vdgs.runs.open_run import OpenedRun, open_run

#: From so many metres on, land counts as far.
FAR_M = 300.0
KINDS = ("sky", "far", "near")


def views_of(run: OpenedRun) -> list[tuple[str, View, np.ndarray]]:
    """The views with their set and true depth in metres."""
    capture = load_capture(run.capture.root, CaptureOptions(validation=True))
    truth, off_path = load_ground_truth(capture.root), load_ground_truth(capture.root / OFF_PATH_FOLDER)
    found = [("validation", view, truth.depth_map(view)) for view in capture.test_views]
    return found + [(off_path_set(view), view, off_path.depth_map(view)) for view in capture.off_path_views]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--pictures", type=Path)
    asked = parser.parse_args()
    opened = [open_run(path, "coarse") for path in asked.runs]
    views, rows = views_of(opened[0]), []
    for path, run in zip(asked.runs, opened, strict=True):
        squared: dict[tuple[str, str], list[np.ndarray]] = {}
        before: dict[str, list[np.ndarray]] = {}
        for index, (name, view, depth) in enumerate(views):
            with torch.inference_mode():
                raster = render(run.model, view.camera)
            photograph, shown = np.asarray(Image.open(view.image_path)), to_8bit(raster.image.numpy())
            if asked.pictures and np.isinf(depth).any():
                if run is opened[0]:
                    rows.append([photograph])
                rows[sum(np.isinf(views[k][2]).any() for k in range(index))].append(shown)
            error = ((shown / 255.0 - photograph / 255.0) ** 2).mean(-1)
            sky, far = np.isinf(depth), np.isfinite(depth) & (depth > FAR_M)
            for kind, chosen in zip(KINDS, (sky, far, ~sky & ~far), strict=True):
                squared.setdefault((name, kind), []).append(error[chosen])
            before.setdefault(name, []).append(raster.alpha.numpy()[sky] > 0.5)
        print(f"{path}: {len(run.model.anchors):,} anchors")
        for name in dict.fromkeys(each[0] for each in views):
            errors = [np.concatenate(squared[name, kind]) for kind in KINDS]
            figures = [f"{k} {-10 * np.log10(e.mean()):.2f} dB" for k, e in zip(KINDS, errors, strict=True) if len(e)]
            hangs = np.concatenate(before[name])
            share = f"; opaque before the sky: {hangs.mean():.1%}" if len(hangs) else ""
            whole = -10 * np.log10(np.concatenate(errors).mean())
            print(f"  {name:12} all {whole:.2f} dB, {', '.join(figures)}{share}")
    if asked.pictures:
        Image.fromarray(np.concatenate([np.concatenate(row, axis=1) for row in rows])).save(asked.pictures)


if __name__ == "__main__":
    main()
