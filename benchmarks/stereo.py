"""Points by stereo against the truth of a generated capture, by how many photographs see a place.

    vdgs synth CAPTURE --size district --flight uneven --images 240 --width 128 --height 96 --extent-m 184 \\
      --points 2000 --test-images 32 --validation-images 32 --truth
    python benchmarks/stereo.py CAPTURE

Precision: the share of the points that lie within a cell of a true surface that some photograph shows. Recall: of what
the test views show, the share with a point within 1.25 cells, by the sparse points alone and with those of stereo.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from machine import describe
from vdgs.captures.capture import Capture, View
from vdgs.captures.images import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.runs.folder import RunFolder
from vdgs.runs.stereo import cell_of, find_points
from vdgs.settings.capture import CaptureOptions
from vdgs.settings.method import AnchorConfig
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
        f"stereo beside them in {time.monotonic() - began:.1f} s, cells of {cell:.3f}"
    )
    surface = np.concatenate([places(view, truth, capture)[0][::EVERY] for view in capture.train_views])
    print(f"precision {(cKDTree(surface).query(found.points)[0] < cell).mean():.1%}\n")
    print(f"{'true V':>10} {'pixels':>7} {'sparse':>7} {'stereo':>7}")
    shown, views = zip(*(places(view, truth, capture, counted=True) for view in capture.test_views), strict=True)
    where, seen = np.concatenate(shown), np.concatenate(views)
    near = [
        cKDTree(points).query(where)[0] < 1.25 * cell
        for points in (capture.points, np.concatenate([capture.points, found.points]))
    ]
    for low, high in GROUPS:
        group = (seen >= low) & (seen <= high)
        label = f"{low}" if low == high else f"{low} to {high}" if high < 10_000 else f"{low} and more"
        print(f"{label:>10} {group.mean():>7.1%}", *(f"{each[group].mean():>7.1%}" for each in near))


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
