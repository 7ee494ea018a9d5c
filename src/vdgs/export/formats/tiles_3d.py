"""3D Tiles 1.1: the scene as a tree of small tiles by place, coarse ones from afar and fine ones near by.

`FOLDER/tileset.json` names the tiles in a folder beside it. The tree is a quadtree over x and y; a leaf holds its part
of the scene as it is, a tile above holds its four children merged (`levels`) to as many Gaussians. A tile is a GLB
around an SPZ, the only kind that CesiumJS draws so far. Tiles stand in local coordinates with z up, each about its own
middle; the root's transform takes them to Earth-centered coordinates where the scene is georeferenced.
"""

from __future__ import annotations

import json
import re
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from vdgs.errors import VdgsError
from vdgs.export.formats import spz
from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene
from vdgs.export.formats.gaussian_store import GaussianStore, write_store
from vdgs.export.formats.gltf import EXTENSION, SPZ_EXTENSION, spz_glb
from vdgs.export.formats.simplify import simplify
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes
from vdgs.kernels import get_backend
from vdgs.model.gaussian_transform import gaussian_covariances, transform_gaussians
from vdgs.model.gaussians import MAX_SIGMA, Gaussians
from vdgs.system.atomic_files import explain_disk_errors, write_bytes, write_json
from vdgs.system.documents import JsonObject
from vdgs.system.scratch import leftovers, remove_leftovers, scratch_folder

TILESET_FILE = "tileset.json"
#: How tiles are named beside their tileset: the folder's number is one that nothing there has yet, the file says where
#: in the quadtree it stands.
_TILE = re.compile(r"tiles-[0-9]+/[0-3]+\.glb")
#: What a killed export may leave there.
_UNFINISHED = re.compile(r"tiles-[0-9]+/([0-3]+\.glb|\.[0-3]+\.glb\.[0-9]+\.tmp)")
#: The file of a scratch folder that names the folder of tiles which is being filled.
_WRITES = "tiles"
#: Gaussians of a tile: about a megabyte with spherical harmonics of degree 3.
MAX_GAUSSIANS_PER_TILE = 50_000
#: The extension of glTF asks for version 2.
SPZ_VERSION = 2
#: Tiles are not divided below this share of the scene: what is closer together stays together, however many there are.
MAX_DEPTH = 16
#: A merged level errs by so many edges of its cells. Viewers go on to finer tiles where the error is larger than (as
#: usual) 16 pixels: cells are then 4 pixels wide.
ERROR_PER_CELL_EDGE = 4.0


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
    if path.is_dir():
        raise VdgsError(f"{path}: is a folder. 3D Tiles are written as FOLDER/{TILESET_FILE}.")


def write_tiles(path: Path, scene: ExportScene, max_gaussians: int = MAX_GAUSSIANS_PER_TILE) -> tuple[str, ...]:
    """Write tiles beside `path` and then, atomically, the tileset that names them; the tiles of the one that was there
    before are removed last, and nothing else.

    The numbers of the scene wait in a file beside it; of them memory holds a place and an index each. Returns what was
    lost. Raises VdgsError.
    """
    check_tileset_folder(path, scene)
    older = tileset_files(path)
    taken = [int(each.name[6:]) for each in path.parent.glob("tiles-*") if each.name[6:].isdecimal()]
    folder = path.parent / f"tiles-{1 + max(taken, default=0)}"
    try:
        with explain_disk_errors(path), scratch_folder(path) as scratch:
            (scratch / _WRITES).write_text(folder.name)
            root = _TileQuadtree(write_store(scene, scratch / "rows"), folder, scene.metadata, max_gaussians).build()
        write_json(path, _tileset(root, scene.metadata))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    _remove(older)
    notes = ["positions are rounded to 0.24 mm, colors and shapes to bytes"]
    if scene.metadata.geodetic is None:
        notes.append("the scene is not georeferenced: globes show it at the center of the Earth")
    return tuple(notes)


def tileset_files(path: Path) -> list[Path]:
    """The files that the tileset at `path` names, where it is one that `write_tiles` wrote; else none.

    Any other tileset, a damaged one, and what is named otherwise than our own tiles is not for us to touch.
    """
    try:
        tileset = json.loads(path.read_bytes())
        if not str(tileset["asset"]["generator"]).startswith("vdgs "):
            return []
        found, waiting = [], [tileset["root"]]
        while waiting:
            entry = waiting.pop()
            found.append(str(entry["content"]["uri"]))
            waiting += entry.get("children", [])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return []
    return [path.parent / uri for uri in sorted(set(found)) if _TILE.fullmatch(uri)]


def remove_killed(path: Path) -> list[Path]:
    """Remove what killed exports of the tileset at `path` left: scratch folders, and the tiles that they had begun.
    Returns what was there. Raises nothing for what cannot be removed."""
    named, begun = set(tileset_files(path)), list[Path]()
    for each in leftovers(path):
        with suppress(OSError, UnicodeDecodeError):
            begun += sorted(path.parent.joinpath((each / _WRITES).read_text()).glob("*"))
    inside = {each: str(each.relative_to(path.parent)) for each in begun if each.parent.parent == path.parent}
    tiles = [each for each, name in inside.items() if _UNFINISHED.fullmatch(name) and each not in named]
    _remove(tiles)
    return [*remove_leftovers(path), *sorted({each.parent for each in tiles})]


def _remove(tiles: list[Path]) -> None:
    """Remove tiles and the folders that are empty then. What people have put beside them stays."""
    for each in tiles:
        with suppress(OSError):
            each.unlink()
    for folder in sorted({each.parent for each in tiles}):
        with suppress(OSError):
            folder.rmdir()


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
        coarse, edge = simplify(together, self.most)
        below = max(child.error for child in children)
        # A lone child is no coarser than its parent: errors must still grow towards the root.
        return self._written(coarse, max(ERROR_PER_CELL_EDGE * edge, 1.25 * below, 1e-3), children, name)

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
