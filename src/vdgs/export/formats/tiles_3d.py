"""3D Tiles 1.1: the scene as a tree of small tiles by place, coarse ones from afar and fine ones near by.

`FOLDER/tileset.json` names the tiles of a quadtree (`tile_quadtree`) in a folder beside it. A tile is a GLB around an
SPZ, the only kind that CesiumJS draws so far. Tiles stand in local coordinates with z up, each about its own middle;
the root's transform takes them to Earth-centered coordinates where the scene is georeferenced.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

from vdgs.export.formats import spz
from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene
from vdgs.export.formats.file_folders import FileFolder, check_no_folder
from vdgs.export.formats.gaussian_store import write_store
from vdgs.export.formats.gltf import EXTENSION, SPZ_EXTENSION, spz_glb
from vdgs.export.formats.tile_quadtree import TilesetNode, build_tile_quadtree
from vdgs.geometry.geodesy import ecef_from_geodetic, enu_axes
from vdgs.model.gaussian_transform import transform_gaussians
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import TEMPORARY_ENDING, write_bytes
from vdgs.system.documents import JsonObject

TILESET_FILE = "tileset.json"
#: Gaussians of a tile: about a megabyte with spherical harmonics of degree 3.
MAX_GAUSSIANS_PER_TILE = 50_000
#: The extension of glTF asks for version 2.
SPZ_VERSION = 2


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
        def write_tile(gaussians: Gaussians, name: str) -> str:
            middle = np.rint((gaussians.means.double().amin(0) + gaussians.means.double().amax(0)).numpy() / 2)
            here = transform_gaussians(gaussians, 1.0, Y_UP.turn, -(Y_UP.turn @ middle))
            content = spz_glb(here, spz.encode_spz(here, SPZ_VERSION), Y_UP.turn @ middle, scene.metadata)
            write_bytes(folder / f"{name}.glb", content)
            return f"{folder.name}/{name}.glb"

        return _tileset(
            build_tile_quadtree(write_store(scene, scratch / "rows"), write_tile, max_gaussians), scene.metadata
        )

    TILE_FOLDER.write(path, fill)
    notes = [spz.ROUNDING_NOTE]
    if scene.metadata.geodetic is None:
        notes.append("the scene is not georeferenced: globes show it at the center of the Earth")
    return tuple(notes)


def named_tiles(path: Path) -> list[str]:
    """The files that our own tileset, or a document with such a tree, names."""
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
TILE_FOLDER = FileFolder("tiles", re.compile(r"[0-3]+\.glb|\.[0-3]+\.glb" + TEMPORARY_ENDING), named_tiles)


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
