"""Whether levels of anchors pay in training (`--model.levels`): PSNR, splats and time of views by the size of their
pixels, for one capture and seed, the coarse stage alone.

    python -m experiments.reports.analyses.training_levels CAPTURE --levels 3 --seed 0 --output levels.jsonl
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from vdgs.captures.capture import Capture, View
from vdgs.captures.image_files import decode_image
from vdgs.captures.loading import load_capture
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import TrainConfig
from vdgs.config.presets import PRESETS
from vdgs.evaluation.metrics import psnr_from_mse, squared_error, to_8bit
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.levels import fit_levels, level_sizes, pixel_sizes
from vdgs.model.renderer import decode_view, render
from vdgs.pipeline.train_in_memory import train_in_memory
from vdgs.training import target


def view_figures(model: AnchorModel, views: list[View]) -> dict[str, float]:
    """PSNR, anchors and splats of the views, and milliseconds of a processor to draw one."""
    found = defaultdict(list)
    for view in views:
        rows, splats = decode_view(model, view.camera)
        begin = time.process_time()
        shown = to_8bit(render(model, view.camera).image.cpu().numpy())
        found["ms"].append(1e3 * (time.process_time() - begin))
        found["psnr"].append(psnr_from_mse(float(squared_error(shown, decode_image(view.image_path)[0]).mean())))
        found["anchors"].append(len(rows))
        found["splats"].append(len(splats.opacities))
    return {name: round(fmean(values), 2) for name, values in found.items()} | {"views": len(views)}


def by_pixel(capture: Capture, points: torch.Tensor, views: tuple[View, ...]) -> dict[str, list[View]]:
    """The views, near and far: by the middle (on a logarithmic scale) between the smallest and the largest pixels."""

    def size(view: View) -> float:
        return float(pixel_sizes(points, view.camera).median())

    sizes = [size(view) for view in capture.train_views]
    middle = (min(sizes) * max(sizes)) ** 0.5
    parts = {"near": [view for view in views if size(view) < middle], "far": [v for v in views if size(v) >= middle]}
    return {name: part for name, part in parts.items() if part}


def measure(folder: Path, config: TrainConfig, device: str) -> dict[str, object]:
    """What one training comes to."""
    capture = load_capture(folder, CaptureOptions())
    listed = (folder / "validation.txt").exists()
    validation = load_capture(folder, CaptureOptions(validation=True)).test_views if listed else ()
    begin, clock = time.process_time(), time.monotonic()
    model = train_in_memory(capture, config, device=device)
    seconds = {"processor": round(time.process_time() - begin, 1), "clock": round(time.monotonic() - clock, 1)}
    points = torch.from_numpy(capture.points.astype(np.float32))
    splits = {"train": capture.train_views, "test": capture.test_views, "validation": validation}
    counts = [int((model.anchors.max_pixels == size).sum()) for size in level_sizes(model.anchors)]
    figures = {
        name: {part: view_figures(model, some) for part, some in by_pixel(capture, points, views).items()}
        for name, views in splits.items()
    }
    sizes = fit_levels(capture.points, [view.camera for view in capture.train_views], config.model.levels)
    return {"anchors": len(model.anchors), "by_level": counts, "pixels": sizes[:-1], "seconds": seconds, **figures}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--levels", type=int, default=0)
    parser.add_argument("--share", type=float, default=target.ALL_LEVELS_SHARE, help="of the steps that draw all levels")
    parser.add_argument("--iterations", type=int, default=1600)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=Path("levels.jsonl"))
    asked = parser.parse_args()
    target.ALL_LEVELS_SHARE = asked.share
    config = replace(PRESETS["laptop"].training, iterations=asked.iterations, seed=asked.seed)
    config = replace(config, model=replace(config.model, levels=asked.levels))
    result = {key: str(value) for key, value in vars(asked).items()} | measure(asked.capture, config, asked.device)
    with asked.output.open("a") as file:
        file.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
