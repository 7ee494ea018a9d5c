"""Points on ground that photographs show but structure-from-motion left empty (canopies, water, fields).

No anchor would start there, and growth cannot cross a wide gap. Choice (the paper is silent): each empty cell of a grid
on the ground plane that a training camera sees gets a point, at the height of the nearest sparse points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from vdgs.geometry.camera import Camera
from vdgs.visibility.visibility_counts import count_visibility

#: Edge of a grid cell in voxels; about as far apart as growth's coarsest cells can bridge.
CELL_VOXELS = 4.0
#: The grid reaches beyond the points by this share of their extent.
MARGIN = 0.1
#: Sparse points whose median height a gap takes.
NUM_NEIGHBORS = 16
#: At most this many gap points per sparse point; cells are widened until they fit.
MAX_GAP_FRACTION = 0.5
MAX_CELLS = 4_000_000


def find_gap_points(
    points: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], voxel: float
) -> Float[np.ndarray, "g 3"]:
    """Points [g, 3] (ground frame, z up) for the empty cells that a camera sees; none where the cover is complete.

    `points` are the sparse points, `voxel` the edge of the anchor grid. Deterministic. O(cells x cameras).
    """
    low, high = np.quantile(points[:, :2], 0.001, axis=0), np.quantile(points[:, :2], 0.999, axis=0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    tree = cKDTree(points[:, :2])
    cell = max(CELL_VOXELS * voxel, float(np.sqrt(np.prod(np.maximum(high - low, voxel)) / MAX_CELLS)))
    while True:
        centers = _empty_cells(points, low, high, cell)
        seen = _at_seen_heights(centers, points, tree, cameras)
        if len(seen) <= MAX_GAP_FRACTION * len(points):
            return seen
        cell *= float(np.sqrt(len(seen) / (MAX_GAP_FRACTION * len(points)))) * 1.05


def _empty_cells(points: np.ndarray, low: np.ndarray, high: np.ndarray, cell: float) -> Float[np.ndarray, "c 2"]:
    """Centers of the cells that hold no point and touch none that does."""
    shape = tuple(int(count) for count in np.maximum(np.ceil((high - low) / cell), 1))
    index = np.floor((points[:, :2] - low) / cell).astype(np.int64)
    index = index[((index >= 0) & (index < shape)).all(axis=1)]
    held: Bool[np.ndarray, "x y"] = np.zeros(shape, bool)
    held[index[:, 0], index[:, 1]] = True
    empty = np.argwhere(~binary_dilation(held, structure=np.ones((3, 3), bool)))
    return low + (empty + 0.5) * cell


def _at_seen_heights(
    centers: np.ndarray, points: np.ndarray, tree: cKDTree, cameras: Sequence[Camera]
) -> Float[np.ndarray, "g 3"]:
    """The centers lifted to the ground about them, where a camera sees them."""
    if not len(centers):
        return np.zeros((0, 3))
    _, nearest = tree.query(centers, k=min(NUM_NEIGHBORS, len(points)), workers=1)
    heights = np.median(points[np.asarray(nearest).reshape(len(centers), -1), 2], axis=1)
    lifted = np.column_stack([centers, heights])
    return lifted[count_visibility(torch.from_numpy(lifted), cameras).numpy() > 0]
