"""Blocks of HUG: boxes on the ground with equally many sparse points, and the pixels of each view that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.visibility.frustum import project_points

#: Pixels are classified on a grid with so many cells along the longer side of a picture.
GRID_CELLS = 64


@dataclass(frozen=True)
class GroundBoxes:
    """Boxes that cut the ground plane without gaps: the outer ones are unbounded."""

    low: Float[np.ndarray, "b 2"]
    high: Float[np.ndarray, "b 2"]
    #: What the sparse points of each box span.
    size: Float[np.ndarray, "b 2"]

    def __len__(self) -> int:
        return len(self.low)

    def holds(self, block: int, xy: Float[Tensor, "n 2"], margin: float = 0.0) -> Bool[Tensor, " n"]:
        """Which places a box holds, widened on each side by a share of its size; its lower sides belong to it."""
        wider = margin * self.size[block]
        low, high = (torch.from_numpy(side).to(xy) for side in (self.low[block] - wider, self.high[block] + wider))
        return ((xy >= low) & (xy < high)).all(dim=1)

    def owner(self, xy: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        """The box of each place."""
        held = [self.holds(block, torch.from_numpy(xy)).numpy() for block in range(len(self))]
        return np.argmax(held, axis=0)


def cut_ground(points: Float[np.ndarray, "p 3"], count: int) -> GroundBoxes:
    """So many boxes of about equally many points: the largest side is cut where it halves them, again and again."""
    boxes = [(points[:, :2], np.full(2, -np.inf), np.full(2, np.inf), count)]
    done = []
    while boxes:
        inside, low, high, parts = boxes.pop()
        if parts == 1 or len(inside) < 2:
            done.append((low, high, np.ptp(inside, axis=0) if len(inside) else np.zeros(2)))
            continue
        axis, first = int(np.argmax(np.ptp(inside, axis=0))), parts // 2
        at = float(np.quantile(inside[:, axis], first / parts))
        below, above = high.copy(), low.copy()
        below[axis] = above[axis] = at
        left = inside[:, axis] < at
        boxes += [(inside[~left], above, high, parts - first), (inside[left], low, below, first)]
    low_, high_, size = (np.stack(each) for each in zip(*done, strict=True))
    return GroundBoxes(low_, high_, size)


def pixel_owners(
    points: Float[np.ndarray, "p 3"], owner: Int64[np.ndarray, " p"], cameras: Sequence[Camera], neighbors: int
) -> list[Int64[np.ndarray, "_h _w"]]:
    """For each view the block of each cell of a grid over the picture: that of most of the nearest projected points;
    -1 throughout where the view holds none."""
    places, count = torch.from_numpy(points), int(owner.max()) + 1
    return [_cell_owners(places, owner, camera, neighbors, count) for camera in cameras]


def _cell_owners(
    places: Float[Tensor, "p 3"], owner: Int64[np.ndarray, " p"], camera: Camera, neighbors: int, count: int
) -> Int64[np.ndarray, "_h _w"]:
    small = camera.limit_size(GRID_CELLS)
    seen = project_points(places, small)
    inside, pixels = seen.inside.numpy(), torch.stack([seen.column, seen.row], dim=1).numpy()
    if not inside.any():
        return np.full((small.height, small.width), -1)
    rows, columns = np.mgrid[: small.height, : small.width] + 0.5
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1)
    k = min(neighbors, int(inside.sum()))
    _, nearest = cKDTree(pixels[inside]).query(cells, k=k, workers=1)
    labels = owner[inside][np.asarray(nearest).reshape(len(cells), k)]
    votes = np.stack([(labels == block).sum(axis=1) for block in range(count)], axis=1)
    return votes.argmax(axis=1).reshape(small.height, small.width)
