"""3D Tiles 1.1: the scene as a tree of small tiles by place, coarse ones from afar and fine ones near by.

`FOLDER/tileset.json` names the tiles in a folder beside it. The tree is a quadtree over x and y; a leaf holds its part
of the scene as it is, a tile above holds its four children merged (`model.gaussian_merging`) to as many Gaussians. A
tile is a GLB around an SPZ, the only kind that CesiumJS draws so far. Tiles stand in local coordinates with z up, each
about its own middle; the root's transform takes them to Earth-centered coordinates where the scene is georeferenced.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from vdgs.export.formats import spz
from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene
from vdgs.export.formats.file_folders import FileFolder, check_no_folder
from vdgs.export.formats.gaussian_store import GaussianStore, write_store
from vdgs.export.formats.gltf import EXTENSION, SPZ_EXTENSION, spz_glb
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes
from vdgs.kernels import get_backend
from vdgs.model.gaussian_merging import merge_to
from vdgs.model.gaussian_transform import gaussian_covariances, transform_gaussians
from vdgs.model.gaussians import MAX_SIGMA, Gaussians
from vdgs.system.atomic_files import write_bytes
from vdgs.system.documents import JsonObject

TILESET_FILE = "tileset.json"
#: Gaussians of a tile: about a megabyte with spherical harmonics of degree 3.
MAX_GAUSSIANS_PER_TILE = 50_000
#: The extension of glTF asks for version 2.
SPZ_VERSION = 2
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


def check_tileset_folder(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where the folder belongs to something else."""
    check_no_folder(path, "3D Tiles")


def write_tiles(path: Path, scene: ExportScene, max_gaussians: int = MAX_GAUSSIANS_PER_TILE) -> tuple[str, ...]:
    """Write tiles beside `path` and then, atomically, the tileset that names them; the tiles of the one that was there
    before are removed last, and nothing else.

    The numbers of the scene wait in a file beside it; of them memory holds a place and an index each. Returns what was
    lost. Raises VdgsError.
    """
    check_tileset_folder(path, scene)

    def fill(folder: Path, scratch: Path) -> JsonObject:
        tree = _TileQuadtree(write_store(scene, scratch / "rows"), folder, scene.metadata, max_gaussians)
        return _tileset(tree.build(), scene.metadata)

    TILE_FOLDER.write(path, fill)
    notes = ["positions are rounded to 0.24 mm, colors and shapes to bytes"]
    if scene.metadata.geodetic is None:
        notes.append("the scene is not georeferenced: globes show it at the center of the Earth")
    return tuple(notes)


def _named_tiles(path: Path) -> list[str]:
    """The tiles that our own tileset names."""
    tileset = json.loads(path.read_bytes())
    if not str(tileset["asset"]["generator"]).startswith("vdgs "):
        return []
    found, waiting = list[str](), [tileset["root"]]
    while waiting:
        entry = waiting.pop()
        found.append(str(entry["content"]["uri"]))
        waiting += entry.get("children", [])
    return found


#: A tile's name says where in the quadtree it stands.
TILE_FOLDER = FileFolder("tiles", re.compile(r"[0-3]+\.glb|\.[0-3]+\.glb\.[0-9]+\.tmp"), _named_tiles)


class _TileQuadtree:
    """The quadtree while it is built, from the leaves up."""

    def __init__(self, scene: GaussianStore, folder: Path, facts: ExportMetadata, max_count: int) -> None:
        self.scene, self.folder, self.facts, self.most = scene, folder, facts, max_count
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
        middle = np.rint((gaussians.means.double().amin(0) + gaussians.means.double().amax(0)).numpy() / 2)
        file = self.folder / f"{name}.glb"
        here = transform_gaussians(gaussians, 1.0, Y_UP.turn, -(Y_UP.turn @ middle))
        write_bytes(file, spz_glb(here, spz.encode_spz(here, SPZ_VERSION), Y_UP.turn @ middle, self.facts))
        entry: JsonObject = {
            "boundingVolume": {"box": _box_of(low, high)}, "geometricError": error,
            "content": {"uri": f"{self.folder.name}/{file.name}"},
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


def _tileset(root: TilesetNode, metadata: ExportMetadata) -> JsonObject:
    needs = {"extensionsUsed": [EXTENSION, SPZ_EXTENSION], "extensionsRequired": [EXTENSION, SPZ_EXTENSION]}
    top = {"transform": tile_transform(metadata), "refine": "REPLACE", **root.entry}
    return {
        "asset": {
            "version": "1.1",
            "generator": metadata.program,
            "extras": {**metadata.to_dict(), "axes": "east, north, up"},
        },
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": needs},
        "geometricError": max(2 * root.error, float(np.linalg.norm(root.high - root.low)) / 4),
        "root": top,
    }


def tile_transform(metadata: ExportMetadata) -> list[float]:
    """4 × 4, column by column, from local coordinates to Earth-centered metres; the identity without a known place."""
    matrix = np.eye(4)
    if metadata.geodetic is not None:
        matrix[:3, :3] = enu_axes(metadata.geodetic[0], metadata.geodetic[1]).T
        matrix[:3, 3] = ecef_from_geodetic(np.array([metadata.geodetic]))[0]
    return [float(value) for value in matrix.T.ravel()]
