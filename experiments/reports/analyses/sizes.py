"""How large new anchors may be (`model/sizes.py`), asked of all cameras at once, beside one camera after the other.

    python -m experiments.reports.analyses.sizes [--threads 1]

New anchors of one decision of growth, all over a square of 640 m, under cameras tilted by 30 degrees. Both must agree
bit for bit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import torch
from experiments.microbench.machine import describe
from experiments.microbench.visibility import flight, scene
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.model.frustum import project
from vdgs.model.groups import Groups
from vdgs.model.sizes import REACH, SPAN, largest_log_scales

EXTENT_M = 640.0
#: New anchors, cameras.
CASES = [(2_000, 640), (2_000, 5_000), (20_000, 5_000), (2_000, 20_000)]


def one_by_one(positions: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """The same for places that some camera holds, camera after camera; infinite elsewhere."""
    bound = torch.full_like(positions[:, 0], torch.inf)
    groups = Groups.of(positions)
    for camera in cameras:
        rows = groups.about(camera)
        seen = project(positions[rows], camera)
        rows, depth = rows[seen.inside], seen.depth[seen.inside]
        span = max(camera.width, camera.height) / max(camera.fx, camera.fy)
        bound[rows] = torch.minimum(bound[rows], span * depth)
    return (bound * (SPAN / (2.0 * REACH))).log()


def main() -> None:
    """Print one line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    torch.set_num_threads(parser.parse_args().threads)
    print(describe())
    print(f"{'new anchors':>11} {'cameras':>7} {'at once s':>9} {'one by one s':>12} {'held':>6} {'differing':>9}")
    for count, views in CASES:
        places, cameras = scene(count, EXTENT_M), flight(views, EXTENT_M, 120.0, 30.0)
        began = time.perf_counter()
        together = largest_log_scales(places, cameras)
        seconds = time.perf_counter() - began
        began = time.perf_counter()
        alone = one_by_one(places, cameras)
        slowly = time.perf_counter() - began
        held = alone.isfinite()
        differing = int((together[held] != alone[held]).sum())
        print(f"{count:11} {views:7} {seconds:9.2f} {slowly:12.2f} {float(held.float().mean()):6.0%} {differing:9}")


if __name__ == "__main__":
    main()
