"""A scene as a quadtree over x and y, in the words of 3D Tiles: coarse nodes from afar, fine ones near by.

A leaf holds its part of the scene as it is, a node above holds its four children merged (`model.gaussian_merging`) to
as many Gaussians, and replaces them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from vdgs.export.formats.gaussian_store import GaussianStore
from vdgs.kernels import get_backend
from vdgs.model.gaussian_merging import merge_to
from vdgs.model.gaussian_transform import gaussian_covariances
from vdgs.model.gaussians import MAX_SIGMA, Gaussians
from vdgs.system.documents import JsonObject

#: Writes the Gaussians of a node of a name, digits that say where in the tree it stands, and returns the address.
WriteContent = Callable[[Gaussians, str], str]
#: Tiles are not divided below this share of the scene: what is closer together stays together, however many there are.
MAX_DEPTH = 16
#: A merged level errs by so many of the widths that it merged. Viewers go on to finer tiles where the error is larger
#: than (as usual) 16 pixels: what is merged is then 4 pixels wide.
ERROR_PER_WIDTH = 4.0


@dataclass(frozen=True)
class TilesetNode:
    """What the tileset says of a tile, what stands in it, and the box of all that it covers (z up)."""

    entry: JsonObject
    gaussians: Gaussians
    low: np.ndarray
    high: np.ndarray
    error: float


def build_tile_quadtree(scene: GaussianStore, write: WriteContent, max_count: int) -> TilesetNode:
    """Write all nodes of a scene, at most so many Gaussians in each, and return the root."""
    return _Quadtree(scene, write, max_count).build()


class _Quadtree:
    """The quadtree while it is built, from the leaves up."""

    def __init__(self, scene: GaussianStore, write: WriteContent, max_count: int) -> None:
        self.scene, self.write, self.most = scene, write, max_count
        # Along a Morton curve neighbors follow each other: tiles are smaller, and read from the disk in one go.
        self.order = get_backend(torch.device("cpu")).morton_order(torch.from_numpy(scene.means)).numpy()

    def build(self) -> TilesetNode:
        plane = self.scene.means[:, :2].astype(np.float64)
        low, high = plane.min(0), plane.max(0)
        half = max(float((high - low).max()) / 2, 1e-6)
        return self._tile(self.order, (low + high) / 2, half, "0")

    def _tile(self, rows: np.ndarray, middle: np.ndarray, half: float, name: str) -> TilesetNode:
        if len(rows) <= self.most or len(name) > MAX_DEPTH:
            return self._written(self.scene.rows(rows), 0.0, [], name)
        quarter = (self.scene.means[rows, :2] >= middle) @ np.array([1, 2])
        children = [
            self._tile(rows[quarter == index], middle + half / 2 * np.array([2 * (index & 1) - 1, (index & 2) - 1]),
                       half / 2, f"{name}{index}")
            for index in range(4) if (quarter == index).any()
        ]  # fmt: skip
        together = children[0].gaussians
        for child in children[1:]:
            together = together.concat(child.gaussians)
        coarse, width = merge_to(together, self.most)
        below = max(child.error for child in children)
        # A lone child is no coarser than its parent: errors must still grow towards the root.
        return self._written(coarse, max(ERROR_PER_WIDTH * width, 1.25 * below, 1e-3), children, name)

    def _written(self, gaussians: Gaussians, error: float, children: list[TilesetNode], name: str) -> TilesetNode:
        low, high = _box(gaussians)
        for child in children:
            low, high = np.minimum(low, child.low), np.maximum(high, child.high)
        entry: JsonObject = {
            "boundingVolume": {"box": _box_of(low, high)}, "geometricError": error,
            "content": {"uri": self.write(gaussians, name)},
        }  # fmt: skip
        if children:
            entry |= {"refine": "REPLACE", "children": [child.entry for child in children]}
        return TilesetNode(entry, gaussians, low, high, error)


def _box(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates that the Gaussians reach."""
    reach = MAX_SIGMA * gaussian_covariances(gaussians).diagonal(dim1=1, dim2=2).clamp_min(0).sqrt()
    return (gaussians.means - reach).amin(0).double().numpy(), (gaussians.means + reach).amax(0).double().numpy()


def _box_of(low: np.ndarray, high: np.ndarray) -> list[float]:
    """3D Tiles' box: its middle and its half axes."""
    return [*((low + high) / 2).tolist(), *np.diag((high - low) / 2).ravel().tolist()]
