"""The cut of DOGS (its section 4.1), as its program makes it: sparse points and camera positions are cut alike, and the
cameras of a cell train the points of the cell with the same place in the grid.

Along the first principal axis of the cameras into columns of equal width, and each column, shrunk to what it holds,
along the second into equal rows. Cells are widened `EXPANSION` times, of points and of cameras.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float

from experiments.baselines.gaussian_blocks.cut import GaussianCut, points_held
from vdgs.geometry.camera import Camera
from vdgs.partition.blocks import Block, Blocks, xy_positions
from vdgs.partition.clustering import fit_principal_plane
from vdgs.partition.strategies import DOGS_EXPANSION as EXPANSION
from vdgs.partition.strategies import checked_xy, grid_shape, scale_shape

#: What lies beyond these quantiles does not say how large the scene is (program).
QUANTILES = (0.02, 0.98)


def cut_dogs(points: Float[np.ndarray, "n 3"], cameras: Sequence[Camera], count: int) -> GaussianCut:
    """Cells that hold no points are left out. A camera outside all widened cells joins the nearest (choice); a block
    without cameras gets the one that holds most of its points (choice)."""
    ground, centers = checked_xy(points), np.array([camera.position[:2] for camera in cameras], np.float64)
    plane = fit_principal_plane(centers)
    places, stands = plane.to_plane(ground), plane.to_plane(centers)
    size = np.ptp(np.quantile(places, QUANTILES, axis=0), axis=0) + 1e-9
    columns, rows = grid_shape(count, float(size[0] / size[1]))
    of_points, of_cameras = grid_cells(places, columns, rows), grid_cells(stands, columns, rows)
    cores = [plane.to_ground(cell) for cell in of_points]
    kept = np.unique(Blocks(tuple(Block(core, core) for core in cores)).owner(ground)).tolist()
    blocks = Blocks(tuple(Block(cores[cell], scale_shape(cores[cell], EXPANSION)) for cell in kept))
    joined = cameras_in_cells([of_cameras[cell] for cell in kept], stands)
    held = points_held(points, blocks.owner(xy_positions(points)), len(blocks), cameras)
    for block in np.flatnonzero(~joined.any(axis=0)):
        joined[int(held[:, block].argmax()), block] = held[:, block].any()
    warnings = [] if len(kept) == count else [f"the scene is cut into {len(kept)} blocks instead of {count}"]
    return GaussianCut.of(blocks, joined, warnings)


def grid_cells(places: Float[np.ndarray, "n 2"], columns: int, rows: int) -> list[shapely.Polygon]:
    """The cells of places in the plane, column by column."""
    (west, south), (east, north) = np.quantile(places, QUANTILES, axis=0)
    cells, inner = [], places[(places[:, 1] >= south) & (places[:, 1] <= north)]
    edges = np.linspace(west, east, columns + 1)
    for column in range(columns):
        inside = inner[(inner[:, 0] >= edges[column]) & (inner[:, 0] <= edges[column + 1])]
        if len(inside):
            low, high = inside.min(axis=0), inside.max(axis=0)
        else:
            low, high = np.array([edges[column], south]), np.array([edges[column + 1], north])
        across = np.linspace(low[1], high[1], rows + 1)
        cells += [_box(low[0], across[row], high[0], across[row + 1]) for row in range(rows)]
    return cells


def _box(west: float, south: float, east: float, north: float) -> shapely.Polygon:
    """At least a little wide and high: all cameras may stand in a line."""
    return shapely.box(west, south, max(east, west + 1e-6), max(north, south + 1e-6))


def cameras_in_cells(cells: Sequence[shapely.Polygon], stands: Float[np.ndarray, "c 2"]) -> Bool[np.ndarray, "c b"]:
    """Which cameras stand in which widened cell, or nearest to it if in none."""
    widened, places = [scale_shape(cell, EXPANSION) for cell in cells], shapely.points(stands)
    distance = np.stack([shapely.distance(cell, places) for cell in widened], axis=1)
    nearest = distance.min(axis=1, keepdims=True)
    joined: np.ndarray = (distance == 0) | (distance == nearest)
    return joined
