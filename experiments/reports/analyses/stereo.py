"""Points by stereo against the truth of a generated capture, by how many photographs see a place.

    vdgs synth CAPTURE --size district --flight uneven --images 240 --width 128 --height 96 --extent-m 184 \\
      --points 2000 --test-images 32 --validation-images 32 --truth
    python -m experiments.reports.analyses.stereo CAPTURE

Precision: the share of the points that lie within a cell of a true surface that some photograph shows. Recall: of what
the test views show, the share with a point within 1.25 cells, by the sparse points alone and with those of stereo.
Cells are as large as the training photograph that shows a place largest asks for.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from experiments.microbench.machine import describe
from scipy.spatial import cKDTree

from vdgs.cameras import Camera
from vdgs.captures.capture import Capture, View
from vdgs.captures.images import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.runs.folder import RunFolder
from vdgs.runs.stereo import cell_of, find_points
from vdgs.settings.capture import CaptureOptions
from vdgs.settings.method import AnchorConfig
from vdgs.stereo.dense import SIZES, Cell
from vdgs.synth.truth import Truth, load_truth

#: Groups by true V: from, to.
GROUPS = ((1, 1), (2, 2), (3, 4), (5, 7), (8, 10), (11, 17), (18, 40), (41, 10_000))
#: Every so many pixels of the training photographs speak for the true surface.
EVERY = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    asked = parser.parse_args()
    capture, truth = load_capture(asked.capture, CaptureOptions()), load_truth(asked.capture)
    config = AnchorConfig(stereo=True)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, ImageCache(capture.train_views, 10**9) as images:
        run = RunFolder(Path(folder))
        run.coarse.path.mkdir()
        found = find_points(run, capture, images, config, lambda done, of: None, torch.get_num_threads())
    assert found is not None
    cell = cell_of(capture, config)
    print(describe())
    print(
        f"{len(capture.train_views)} photographs, {len(capture.points):,} sparse points, {len(found.points):,} by "
        f"stereo beside them in {time.monotonic() - began:.1f} s, cells of {cell.least:.3f} and more"
    )
    surface = np.concatenate([places(view, truth, capture)[0][::EVERY] for view in capture.train_views])
    cameras = [view.camera for view in capture.train_views]
    within = cKDTree(surface).query(found.points)[0] < edges(cell, cameras, found.points)
    print(f"precision {within.mean():.1%}\n")
    print(f"{'true V':>10} {'pixels':>7} {'sparse':>7} {'stereo':>7}")
    shown, views = zip(*(places(view, truth, capture, counted=True) for view in capture.test_views), strict=True)
    where, seen = np.concatenate(shown), np.concatenate(views)
    reach = 1.25 * edges(cell, cameras, where)
    near = [
        cKDTree(points).query(where)[0] < reach
        for points in (capture.points, np.concatenate([capture.points, found.points]))
    ]
    for low, high in GROUPS:
        group = (seen >= low) & (seen <= high)
        label = f"{low}" if low == high else f"{low} to {high}" if high < 10_000 else f"{low} and more"
        print(f"{label:>10} {group.mean():>7.1%}", *(f"{each[group].mean():>7.1%}" for each in near))


def edges(cell: Cell, cameras: Sequence[Camera], points: np.ndarray) -> np.ndarray:
    """The edge [n] of the cells at points [n, 3]."""
    pixel = np.full(len(points), np.inf)
    for camera in cameras:
        _, depth = camera.project(points)
        pixel = np.minimum(pixel, np.where(camera.sees(points), depth / camera.fx, np.inf))
    return cell.least * SIZES[cell.sizes(np.where(np.isfinite(pixel), pixel, 0.0))]


def places(
    view: View, truth: Truth, capture: Capture, counted: bool = False
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The true places [p, 3] that a view shows, sky left out; with `counted` true V [p] of each, and none of V 0."""
    depth = capture.ground.scale * truth.depth_map(view)
    kept = np.isfinite(depth)
    seen = truth.visibility_map(view) if counted else np.ones_like(depth)
    kept &= np.nan_to_num(seen) >= 1
    return view.camera.unproject(np.where(kept, depth, 1.0))[kept], seen[kept]


if __name__ == "__main__":
    main()
