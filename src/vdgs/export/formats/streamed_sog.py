"""Streamed SOG, PlayCanvas' `lod-meta.json`: the scene in levels, of which a viewer loads what is near finely.

The ground is cut into nodes. A node holds its part of the scene in each level: as it is, and merged
(`model.gaussian_merging`) to a quarter again and again. Nodes of a level that lie beside each other share an unbundled
SOG, `lod-N/LEVEL_FILE/meta.json` with its images; the document says which rows are a node's. Layout: version 1, as
PlayCanvas' splat-transform 2.7 writes and their engine (`gsplat-octree.js`) reads it. The frame is that of `.sog`.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from vdgs.export.formats.axes import Y_DOWN
from vdgs.export.formats.codebooks import VectorCodebook
from vdgs.export.formats.export_scene import ExportMetadata, ExportScene, concatenate, write_metadata_file
from vdgs.export.formats.file_folders import FileFolder, check_no_folder
from vdgs.export.formats.gaussian_store import GaussianStore, in_memory, plane_blocks, write_store
from vdgs.export.formats.sog import CODEBOOK_NOTE, MAX_SH_CENTROIDS, fit_palette, write_sog_folder
from vdgs.kernels import get_backend
from vdgs.model.gaussian_merging import merge_to
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import TEMPORARY_ENDING
from vdgs.system.documents import JsonObject
from vdgs.system.stop_signals import check_stop_requested

LOD_FILE = "lod-meta.json"
#: Gaussians of a node in the finest level.
MAX_NODE_SIZE = 1 << 14
#: A file is full with so many.
FILE_SIZE = 1 << 17
#: Each level has this part of the Gaussians of the one before.
LEVEL_RATIO = 4
#: Levels are added until the coarsest has no more than so many, or there are so many levels.
COARSEST_SIZE, MAX_LEVELS = 1 << 17, 6


def check_lod_folder(path: Path, scene: ExportScene) -> None:
    """Raise VdgsError where a folder stands in the document's place."""
    check_no_folder(path, "Streamed SOGs")


def write_streamed_sog(path: Path, scene: ExportScene, node_size: int = MAX_NODE_SIZE) -> tuple[str, ...]:
    """Write the files of all levels beside `path` and then, atomically, the document that names them; those of an
    earlier one are removed last. Returns what was lost. Raises VdgsError.

    The numbers of the scene wait in a file beside it; memory holds a file of each level.
    """
    check_lod_folder(path, scene)
    axes = scene.axes or Y_DOWN
    levels = level_count(scene.count)

    def fill(folder: Path, scratch: Path) -> JsonObject:
        # Along the axes of the files: colors that change with the direction turn with them.
        store = write_store(scene, scratch / "rows", axes)
        files, nodes = _LevelFiles(folder, levels, fit_palette(store), scene.metadata), []
        for block in plane_blocks(store.means @ axes.turn.astype(np.float32), np.arange(scene.count), node_size):
            check_stop_requested()
            nodes.append(_node(store, block, files))
        files.finish()
        return _document(nodes, files, scene.metadata)

    LOD_FOLDER.write(path, fill)
    write_metadata_file(path, scene.metadata, axes)
    notes = [f"{levels} levels: each coarser one merged to a quarter of the Gaussians"] if levels > 1 else []
    notes += ["positions are rounded", CODEBOOK_NOTE]
    if scene.degree:
        notes.append(f"changing colors are taken from a palette of at most {MAX_SH_CENTROIDS}")
    return tuple(notes)


def level_count(count: int) -> int:
    """Levels of a scene of so many Gaussians."""
    levels = 1
    while count > COARSEST_SIZE and levels < MAX_LEVELS:
        count, levels = count // LEVEL_RATIO, levels + 1
    return levels


def _node(store: GaussianStore, rows: np.ndarray, files: _LevelFiles) -> JsonObject:
    """What the document says of a node, which is written in all levels."""
    gaussians, lods = store.rows(rows), {}
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for level in range(files.levels):
        if level:
            gaussians = merge_to(gaussians, max(len(gaussians) // LEVEL_RATIO, 1))[0]
        ordered = gaussians.select(get_backend(torch.device("cpu")).morton_order(gaussians.means))
        means = ordered.means.double().numpy()
        low, high = np.minimum(low, means.min(0)), np.maximum(high, means.max(0))
        lods[str(level)] = files.add(level, ordered)
    return {"bound": {"min": low.tolist(), "max": high.tolist()}, "lods": lods}


@dataclass(eq=False)
class _LevelFiles:
    """The files of all levels while they fill, node by node."""

    folder: Path
    levels: int
    palette: VectorCodebook | None
    facts: ExportMetadata
    names: list[str] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.counts = [0] * self.levels
        self._open: list[list[Gaussians]] = [[] for _ in range(self.levels)]
        self._number: list[int] = [0] * self.levels
        self._index: list[int] = [-1] * self.levels

    def add(self, level: int, gaussians: Gaussians) -> JsonObject:
        """Put a node's Gaussians into a file of a level: which, and where in it."""
        waiting = self._open[level]
        offset = sum(map(len, waiting))
        if not waiting:
            self._index[level] = len(self.names)
            self.names.append(f"{self.folder.name}/{self._name(level)}/meta.json")
        waiting.append(gaussians)
        place: JsonObject = {"file": self._index[level], "offset": offset, "count": len(gaussians)}
        self.counts[level] += len(gaussians)
        if offset + len(gaussians) >= FILE_SIZE:
            self._write(level)
        return place

    def finish(self) -> None:
        """Write the files that are not full."""
        for level, waiting in enumerate(self._open):
            if waiting:
                self._write(level)

    def _name(self, level: int) -> str:
        return f"{level}_{self._number[level]}"

    def _write(self, level: int) -> None:
        write_sog_folder(
            self.folder / self._name(level), in_memory(concatenate(self._open[level])), self.palette, self.facts
        )
        self._open[level], self._number[level] = [], self._number[level] + 1


def _document(nodes: list[JsonObject], files: _LevelFiles, facts: ExportMetadata) -> JsonObject:
    low, high = (np.array([node["bound"][end] for node in nodes]) for end in ("min", "max"))
    return {
        "version": 1, "asset": {"generator": facts.program, "extras": facts.to_dict()}, "count": sum(files.counts),
        "counts": files.counts, "lodLevels": files.levels, "filenames": files.names,
        "tree": {"bound": {"min": low.min(0).tolist(), "max": high.max(0).tolist()}, "children": nodes},
    }  # fmt: skip


def _named_files(path: Path) -> list[str]:
    """The files that our own document names, with the images beside them."""
    document = json.loads(path.read_bytes())
    if not str(document["asset"]["generator"]).startswith("vdgs "):
        return []
    folders = [str(Path(name).parent) for name in document["filenames"] if not Path(name).is_absolute()]
    return [f"{each}/{file.name}" for each in folders for file in sorted(path.parent.joinpath(each).iterdir())]


LOD_FOLDER = FileFolder(
    "lod", re.compile(rf"[0-9]+_[0-9]+/\.?(meta\.json|[A-Za-z0-9_]+\.webp)({TEMPORARY_ENDING})?"), _named_files
)
