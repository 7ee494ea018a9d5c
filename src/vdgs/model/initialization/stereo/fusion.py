"""Points on what a flight shows: the depths of all its photographs, where others confirm them, one for each cell.

Cells are as large as pixels are there: what is only seen from afar has cells of two, four, ... times the edge. Fine
ones would hold the noise of depths there, and nobody can bear so many.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from scipy.spatial import cKDTree

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.initialization.stereo.sgm import MAX_RELATIVE_DIFFERENCE, StereoView, multi_view_depth
from vdgs.model.initialization.stereo.view_selection import points_in_view, select_source_views
from vdgs.system.atomic_files import disk_hint
from vdgs.system.units import data_size
from vdgs.visibility.spatial_groups import SpatialGroups

#: Photographs are matched at this longest side, and enlarged at most by so much: steps of a sixteenth of a column tell
#: depth better in larger pictures (choice).
MATCHING_SIDE_PX, MAX_UPSCALE = 480, 1.5
#: Depths are looked for between these quantiles of a photograph's sparse points, and this much nearer and farther.
DEPTH_QUANTILES, DEPTH_MARGIN = (0.01, 0.99), 0.2
#: Edges of cells are the least one times these. Keys have room for so many.
CELL_SCALES = 2.0 ** np.arange(4)
#: A cell holds a point where the confirmed pixels of all photographs in it would together cover so much of one of its
#: faces: what is matched wrongly is strewn over many cells (choice; reports/few-cameras.md).
MIN_COVERAGE = 0.05
#: Points keep so many cells from each other: a surface cuts the corners of cells, and each corner would have its own.
MIN_SPACING = 0.7
#: A pixel counts where at least one partner agrees on its depth, and at least this share of those that hold the place:
#: one among many agrees by chance. Not more, for some of them do not see it.
MIN_AGREEING_FRACTION = 0.25
#: Gray photographs that are held at a time.
MAX_CACHED_VIEWS = 256
#: Cells of photographs that are held at a time at least, before they are added up (72 bytes each).
MERGE_BATCH = 2**20
#: Cells have keys within this many cells of the origin on each axis: 20 bits each, and the size on top.
MAX_CELL_INDEX = 2**19


@dataclass(frozen=True, eq=False)
class StereoInputs:
    """Cameras at the size of their photographs, sparse points [n, 3], positions [p, 3] for which source views are
    chosen, and a function that reads photograph i: RGB [h, w, 3] and the mask [h, w] of what counts (None: all)."""

    cameras: Sequence[Camera]
    points: Float[np.ndarray, "n 3"]
    sample_points: Float[np.ndarray, "p 3"]
    read_image: Callable[[int], tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None]]


class FusionCell(NamedTuple):
    """The edge of cells that get a point each: the least, in units of the world, and in pixels of the photographs as
    they are used, where those are larger."""

    min_edge: float
    min_pixels: float

    def scale_index(self, pixel: Float[np.ndarray, " p"]) -> Int64[np.ndarray, " p"]:
        """Which of `CELL_SCALES` cells have where a pixel is so wide."""
        wide = np.log2(np.maximum(self.min_pixels * pixel / self.min_edge, 1.0))
        return np.minimum(np.rint(wide).astype(np.int64), len(CELL_SCALES) - 1)


class DensePoints(NamedTuple):
    """Points [m, 3] float64 and their colors [m, 3] uint8."""

    points: Float[np.ndarray, "m 3"]
    colors: UInt8[np.ndarray, "m 3"]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells by their keys [c], which begin with the number of their size, and sums over the pixels that lie in them
    [c, 8]: position, color, 1, and the area that a pixel covers there."""

    keys: Int64[np.ndarray, " c"]
    sums: Float[np.ndarray, "c 8"]

    @staticmethod
    def of(keys: Int64[np.ndarray, " p"], values: Float[np.ndarray, "p 8"]) -> _Cells:
        found, place = np.unique(keys, return_inverse=True)
        sums = np.stack([np.bincount(place.reshape(-1), column, len(found)) for column in values.T], 1)
        return _Cells(found, sums.astype(np.float64))  # bincount of nothing is of whole numbers

    @staticmethod
    def together(some: Sequence[_Cells]) -> _Cells:
        """The cells of all of them, summed in their order."""
        return _Cells.of(np.concatenate([each.keys for each in some]), np.concatenate([each.sums for each in some]))


def compute_dense_points(
    inputs: StereoInputs, cell: FusionCell, scratch_dir: Path, on_progress: Callable[[int, int], None], threads: int = 1
) -> DensePoints:
    """Match every photograph with its source views; each cell with enough confirmed pixels gets their mean.

    `scratch_dir` holds a temporary file of depths. `on_progress(done, total)` is called in this thread after each
    photograph, once for matching and once for confirming. Deterministic for any `threads`; raises what `read_image`
    raises, and VdgsError where the disk has no room.
    """
    cameras = [_matched_size(camera) for camera in inputs.cameras]
    others = select_source_views(inputs.cameras, inputs.sample_points)
    groups = SpatialGroups.of(torch.from_numpy(inputs.points))
    views = lru_cache(MAX_CACHED_VIEWS)(lambda index: _view(inputs, groups, cameras[index], index))
    width, height = max(each.width for each in cameras), max(each.height for each in cameras)
    with tempfile.TemporaryFile(dir=scratch_dir) as file, ThreadPoolExecutor(max(1, threads)) as pool:
        shape = (len(cameras), height, width)
        _reserve(file, 2 * math.prod(shape), scratch_dir)
        depths = np.memmap(file, np.float16, "r+", shape=shape)

        def match(index: int) -> None:
            if others[index]:
                depth = multi_view_depth(views(index), [views(other) for other in others[index]])
                depths[index, : depth.shape[0], : depth.shape[1]] = depth

        def confirm(index: int) -> _Cells:
            return _geometric_consistency(inputs, cameras, depths, index, others[index], cell)

        def confirmed() -> Iterator[_Cells]:
            for done, cells in enumerate(pool.map(confirm, range(len(cameras))), len(cameras) + 1):
                on_progress(done, 2 * len(cameras))
                yield cells

        for done, _ in enumerate(pool.map(match, range(len(cameras))), 1):
            on_progress(done, 2 * len(cameras))
        total = _summed(confirmed())
        del depths
    return _fused(total, cell)


def _reserve(file: IO[bytes], size: int, folder: Path) -> None:
    """Make a file so large with room on its disk: where a mapped file finds none, the system kills the process."""
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            file.truncate(size)
    except OSError as error:
        raise VdgsError(
            f"{folder}: depths of stereo need {data_size(size)} there for a while ({error.strerror}). "
            f"{disk_hint(error)}, then run the same command again."
        ) from error


def _matched_size(camera: Camera) -> Camera:
    longest = max(camera.width, camera.height)
    zoom = min(MATCHING_SIDE_PX / longest, MAX_UPSCALE)
    return camera.resized(max(1, round(zoom * camera.width)), max(1, round(zoom * camera.height)))


def _view(inputs: StereoInputs, groups: SpatialGroups, camera: Camera, index: int) -> StereoView:
    """A photograph gray, at the size at which it is matched."""
    picture, _ = inputs.read_image(index)
    small = camera.width < picture.shape[1]
    gray = cv2.resize(
        cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (camera.width, camera.height),
        interpolation=cv2.INTER_AREA if small else cv2.INTER_CUBIC,
    )  # fmt: skip
    _, depth = camera.project(inputs.points[points_in_view(inputs.cameras[index], inputs.points, groups)])
    near, far = np.quantile(depth, DEPTH_QUANTILES) if len(depth) else (1.0, 1.0)
    return StereoView(camera, gray, float(near) * (1 - DEPTH_MARGIN), float(far) * (1 + DEPTH_MARGIN))


def _geometric_consistency(
    inputs: StereoInputs,
    cameras: Sequence[Camera],
    depths: np.ndarray,
    index: int,
    others: Sequence[int],
    cell: FusionCell,
) -> _Cells:
    """The cells in which confirmed pixels of a photograph lie."""
    camera = cameras[index]
    depth = np.asarray(depths[index, : camera.height, : camera.width], np.float32)
    known = depth > 0
    places = camera.unproject(np.where(known, depth, 1.0))
    some = places[known]
    held, agreed = (np.zeros(len(some), np.int32) for _ in range(2))
    for other in others:
        inside, agrees = _told_by(some, cameras[other], depths[other])
        held, agreed = held + inside, agreed + agrees
    confirmed = known.copy()
    confirmed[known] = (agreed >= 1) & (agreed >= MIN_AGREEING_FRACTION * held)
    confirmed &= (np.abs(places) < MAX_CELL_INDEX * cell.min_edge).all(-1)
    picture, mask = inputs.read_image(index)
    size = (camera.width, camera.height)
    if mask is not None:
        confirmed &= cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0
    colors = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    area = (depth[confirmed].astype(np.float64) ** 2 / (camera.fx * camera.fy))[:, None]
    values = np.concatenate([places[confirmed], colors[confirmed], np.ones_like(area), area], 1)
    sizes = cell.scale_index(depth[confirmed].astype(np.float64) / inputs.cameras[index].fx)
    edge = cell.min_edge * CELL_SCALES[sizes]
    x, y, z = (np.floor(values[:, axis] / edge).astype(np.int64) + MAX_CELL_INDEX for axis in range(3))
    return _Cells.of((sizes << 60) | (x << 40) | (y << 20) | z, values)


def _told_by(
    points: Float[np.ndarray, "p 3"], camera: Camera, depths: Float[np.ndarray, "r c"]
) -> tuple[Bool[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Which places another photograph holds in its picture, and which of them lie where its own depth says."""
    pixels, distance = camera.project(points)
    inside = camera.holds(pixels, distance)
    column, row = (np.where(inside, pixels[:, axis], 0).astype(np.int64) for axis in (0, 1))
    there = np.asarray(depths[row, column], np.float64)
    return inside, inside & (there > 0) & (np.abs(there - distance) < MAX_RELATIVE_DIFFERENCE * distance)


def _summed(photographs: Iterable[_Cells], most_waiting: int = MERGE_BATCH) -> _Cells:
    """The cells of all photographs. Those that wait to be added are at most as many as there are, or `most_waiting`:
    the time is that of one sum of all, and so are the bits, for each cell is summed in the order of the photographs."""
    total, waiting = _Cells(np.zeros(0, np.int64), np.zeros((0, 8))), list[_Cells]()
    for each in photographs:
        waiting.append(each)
        if sum(len(some.keys) for some in waiting) > max(most_waiting, len(total.keys)):
            total, waiting = _Cells.together([total, *waiting]), []
    return _Cells.together([total, *waiting])


def _fused(found: _Cells, cell: FusionCell) -> DensePoints:
    """One point for each cell that the pixels of all photographs cover well enough; of two that lie too close that of
    the smaller cell, or of the better covered one."""
    means = np.zeros((0, 6))
    for size, edge in enumerate(cell.min_edge * CELL_SCALES):
        sums = found.sums[(found.keys >> 60 == size) & (found.sums[:, 7] >= MIN_COVERAGE * edge**2)]
        sums = sums[np.argsort(-sums[:, 7], kind="stable")]
        more = sums[:, :6] / sums[:, 6:7]
        if len(means):
            more = more[cKDTree(means[:, :3]).query(more[:, :3], workers=1)[0] > MIN_SPACING * edge]
        means = np.concatenate([means, more[_apart(more[:, :3], MIN_SPACING * edge)]])
    return DensePoints(means[:, :3], np.clip(np.rint(means[:, 3:]), 0, 255).astype(np.uint8))


def _apart(points: Float[np.ndarray, "n 3"], distance: float) -> Bool[np.ndarray, " n"]:
    """Which points stay where each, in their order, takes the place of those after it that are nearer than that."""
    stays = np.ones(len(points), bool)
    if len(points) < 2:
        return stays
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    pairs = np.sort(pairs, 1)
    for first, second in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        if stays[first]:
            stays[second] = False
    return stays
