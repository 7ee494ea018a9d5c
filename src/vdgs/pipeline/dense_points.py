"""The points that dense stereo adds to the sparse points of a run: computed once, before the coarse stage, and saved.

RUN/coarse/stereo.safetensors goes with the coarse stage: `StageFolder.reset_unless` removes it with all that was made
for other settings.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture
from vdgs.captures.image_cache import ImageCache
from vdgs.config.method import InitConfig
from vdgs.errors import VdgsError
from vdgs.model.initialization.gap_filling import find_gap_points
from vdgs.model.initialization.initialize import get_voxel_size
from vdgs.model.initialization.sky import in_sky
from vdgs.model.initialization.stereo import DensePoints, FusionCell, StereoInputs, compute_dense_points
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import read_tensors, tensors_crc32, write_tensors
from vdgs.training.sky_background import view_skylines
from vdgs.visibility.visibility_counts import count_visibility

DENSE_POINTS_FORMAT = "vdgs-stereo-1"
DENSE_POINTS_FILE = "stereo.safetensors"
#: Edge of the cells that get a point each, in voxels and in pixels of the photographs as they are used: the larger of
#: the two, and two, four or eight times that where pixels are so much larger than below the flight (choice). An anchor
#: has ten Gaussians; growth makes more where that is too few.
CELL_VOXELS, CELL_PX = 1.2, 3.0
#: So many pixels of the images for each point that anchors start from, sparse and dense together: more anchors than
#: that cost time and overfit (choice). Points that few cameras see come first.
PIXELS_PER_POINT = 180


def load_dense_points(run: RunFolder, config: InitConfig) -> DensePoints | None:
    """The dense points of the coarse stage; None where its settings ask for none. VdgsError for a missing or damaged
    file."""
    return _read(run.coarse.path / DENSE_POINTS_FILE) if config.mvs else None


def find_dense_points(
    run: RunFolder,
    capture: Capture,
    images: ImageCache,
    config: InitConfig,
    on_progress: Callable[[int, int], None],
    threads: int,
) -> DensePoints | None:
    """As `load_dense_points`, computed (`match_dense_points`) and saved where they are not yet."""
    file = run.coarse.path / DENSE_POINTS_FILE
    if not config.mvs or file.exists():
        return load_dense_points(run, config)
    return _write(file, match_dense_points(capture, images, config, run.coarse.path, on_progress, threads))


def match_dense_points(
    capture: Capture,
    images: ImageCache,
    config: InitConfig,
    scratch_dir: Path,
    on_progress: Callable[[int, int], None],
    threads: int,
) -> DensePoints:
    """Points away from the sparse ones, none where those are as many as the images can bear.

    `images` are the training images; `on_progress(done, total)` is called after each step, and may raise.
    """
    cameras, room = [view.camera for view in capture.train_views], max_dense_points(capture)
    if not room:
        return DensePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    cell = fusion_cell(capture, config)

    def read(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        cached = images.get(index)
        return cached.image.numpy(), None if cached.mask is None else cached.mask.numpy()

    gaps = find_gap_points(capture.points, cameras, get_voxel_size(capture.points, config))
    inputs = StereoInputs(cameras, capture.points, np.concatenate([capture.points, gaps]), read)
    dense = compute_dense_points(inputs, cell, scratch_dir, on_progress, threads)
    skylines, show_sky = view_skylines(capture, capture.train_views)
    if show_sky:  # clouds match too
        kept = ~in_sky(dense.points, cameras, skylines)
        dense = DensePoints(dense.points[kept], dense.colors[kept])
    if len(dense.points):
        away = np.flatnonzero(cKDTree(capture.points).query(dense.points, workers=1)[0] > cell.min_edge / 2)
        views = count_visibility(torch.from_numpy(dense.points[away]), cameras).numpy()
        chosen = np.sort(away[np.argsort(views, kind="stable")[:room]])
        dense = DensePoints(dense.points[chosen], dense.colors[chosen])
    return dense


def max_dense_points(capture: Capture) -> int:
    """The most points that are added to the sparse ones (`PIXELS_PER_POINT`)."""
    pixels = sum(view.camera.width * view.camera.height for view in capture.train_views)
    return max(0, pixels // PIXELS_PER_POINT - len(capture.points))


def fusion_cell(capture: Capture, config: InitConfig) -> FusionCell:
    """The cells that get a dense point each, in units of the ground frame."""
    focal = float(np.median([view.camera.fx for view in capture.train_views]))
    return FusionCell(
        max(CELL_VOXELS * get_voxel_size(capture.points, config), CELL_PX * camera_height(capture) / focal), CELL_PX
    )


def _write(file: Path, dense: DensePoints) -> DensePoints:
    tensors = {"points": torch.from_numpy(dense.points), "colors": torch.from_numpy(dense.colors)}
    header = {DENSE_POINTS_FORMAT: str(tensors_crc32(tensors))}
    write_atomic(file, lambda temporary: write_tensors(temporary, tensors, header))
    return dense


def _read(file: Path) -> DensePoints:
    tensors, header = read_tensors(file)
    points, colors = (tensors.get(name) for name in ("points", "colors"))
    if points is None or colors is None or header.get(DENSE_POINTS_FORMAT) != str(tensors_crc32(tensors)):
        raise VdgsError(f"{file}: is damaged. Delete it and run the same command again: it is found anew.")
    return DensePoints(points.numpy(), colors.numpy())
