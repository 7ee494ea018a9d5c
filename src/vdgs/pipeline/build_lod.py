"""`vdgs lod`: a level-of-detail tree of a scene, so that views of any size are drawn in bounded time and memory.

RUN/lod/    key, status.json, and the files of `model.lod_nodes`: leaves first, each node after its children, the table
            last. What is there already is kept: a build that was cut off continues.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from vdgs.captures.camera_height import camera_height
from vdgs.config.commands import LodRequest
from vdgs.errors import RunError, VdgsError
from vdgs.export import lod_bake
from vdgs.export.lod_bake import CameraTable, leaf_gaussians, node_record, parent_gaussians
from vdgs.export.parallel import parallel_map
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.lod_format import LOD_FORMAT, TREE_FILE
from vdgs.model.lod_nodes import (
    LodTable,
    NodeRecord,
    anchors_file,
    load_node,
    node_file,
    read_record,
    save_anchors,
    save_node,
)
from vdgs.model.lod_quadtree import Quadtree, build_quadtree
from vdgs.model.lod_scene import model_of_rows
from vdgs.runs.lod_folder import has_lod
from vdgs.runs.lod_status import lod_folder
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import locate_model
from vdgs.runs.run_context import RunContext
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.console import print_warning, track
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import data_size

#: Anchors of a leaf at most.
MAX_LEAF_ANCHORS = 8192
#: Disk that merged Gaussians of all levels take for each Gaussian of the anchors (bytes): 24 to 38 measured.
NODE_BYTES_PER_GAUSSIAN = 44


def build_lod(context: RunContext, request: LodRequest, console: Console) -> Path:
    """Make the tree of a model of a run; nothing if it is there. Returns its folder.

    Raises RunError if the model is not trained, and VdgsError, before any work, where the disk has no room.
    """
    run, location = context.run, locate_model(context.run, request.model)
    print_warning(console, location.warning)
    folder, model_id = lod_folder(run), location.stage.status().model_id or ""
    with folder.locked():
        # By the status too: a build that ended between the table and the status has not said yet what it made.
        if folder.key() == _key(model_id) and has_lod(run, location):
            console.print(f"{folder.path}: the tree of this model is there; nothing to do", highlight=False)
            return folder.path
        reset_peak_memory()
        began = time.monotonic()
        model = load_verified(location.stage, location.key)  # a tree of a damaged model would outlive the damage
        if not len(model.anchors):
            raise RunError(f"{location.stage.model}: holds no anchors, so that there is nothing to make a tree of.")
        folder.reset_unless(_key(model_id))
        _check_disk(folder.path, model)
        cameras = CameraTable([view.camera for view in context.capture.train_views], camera_height(context.capture))
        console.print(f"level-of-detail tree of the {location.summary}", highlight=False)
        folder.set_status(StatusRecord(state="running"))
        progress = run.begin_step("lod", "leaves", "leaves")

        def counted(records: Iterator[NodeRecord], total: int) -> Iterator[NodeRecord]:
            for done, record in enumerate(track(records, "levels of detail", total, console), 1):
                yield record
                progress(done)

        table = build_tree(folder.path, model, model_id, cameras, counted)
        seconds, peak = time.monotonic() - began, peak_memory_bytes()
        status = StatusRecord(
            state="done", anchors=len(model.anchors), model_id=model_id, seconds=seconds, peak_memory_bytes=peak
        )
        folder.set_status(status)
    size = sum(file.stat().st_size for file in folder.path.rglob("*.safetensors"))
    console.print(
        f"tree: {folder.path} ({len(table):,} nodes, {int(table.gaussians.sum()):,} merged Gaussians, "
        f"{data_size(size)}, {seconds:.0f} s, peak memory {data_size(peak)})",
        highlight=False,
    )
    return folder.path


def _key(model_id: str) -> str:
    """What the nodes depend on."""
    settings = [
        MAX_LEAF_ANCHORS, lod_bake.CELLS_PER_EDGE, lod_bake.CAMERAS_PER_LEAF, lod_bake.MAX_CANDIDATES,
        lod_bake.SAMPLES, lod_bake.SH_DEGREE, lod_bake.MAX_WINDOW_PX, lod_bake.MIN_LEAF_ERROR, lod_bake.COLOR_WEIGHTS,
        lod_bake.KMEANS_STEPS, lod_bake.PSEUDO_VIEWS, lod_bake.PSEUDO_ELEVATION,
    ]  # fmt: skip
    return hashlib.sha256(json.dumps([LOD_FORMAT, model_id, settings]).encode()).hexdigest()[:16]


def _check_disk(folder: Path, model: AnchorModel) -> None:
    """Raise VdgsError where the disk has no room for what is still to be written."""
    of_anchor = sum(tensor[:1].nbytes for tensor in model.anchors.tensors().values()) + 4
    per_anchor = of_anchor + NODE_BYTES_PER_GAUSSIAN * model.anchors.offsets.shape[1]
    there = sum(file.stat().st_size for file in folder.rglob("*.safetensors"))
    needed, free = max(len(model.anchors) * per_anchor - there, 0), shutil.disk_usage(folder).free
    if needed > free:
        raise VdgsError(
            f"{folder}: the level-of-detail tree takes up to {data_size(needed)}, and {data_size(free)} are free. Free "
            "some space on that disk, then run the same command again."
        )


def build_tree(
    folder: Path,
    model: AnchorModel,
    model_id: str,
    cameras: CameraTable,
    counted: Callable[[Iterator[NodeRecord], int], Iterator[NodeRecord]] = lambda records, _: records,
) -> LodTable:
    """Make the files of a tree that are not there yet. `counted` passes on what is known of the leaves, of so many."""
    builder = _Builder(folder, model, build_quadtree(model.anchors.positions.numpy(), MAX_LEAF_ANCHORS), cameras)
    table = builder.build(model_id, counted)
    table.save(folder / TREE_FILE)
    return table


class _Builder:
    """Makes the nodes of a tree, leaves first."""

    def __init__(self, folder: Path, model: AnchorModel, tree: Quadtree, cameras: CameraTable) -> None:
        self._folder, self._model, self._tree, self._cameras = folder, model, tree, cameras
        self._children: list[list[int]] = [[] for _ in tree.parent]
        for node, parent in enumerate(tree.parent[1:].tolist(), 1):
            self._children[parent].append(node)
        self._records: dict[int, NodeRecord] = {}

    def build(self, model_id: str, counted: Callable[[Iterator[NodeRecord], int], Iterator[NodeRecord]]) -> LodTable:
        """Make what is not there; returns the table of all nodes."""
        tree = self._tree
        leaves, inner = np.flatnonzero(tree.is_leaf).tolist(), np.flatnonzero(~tree.is_leaf)
        done = counted(parallel_map(self._make_leaf, leaves), len(leaves))
        self._keep(leaves, done)
        for level in self._levels(inner):
            self._keep(level, parallel_map(self._make_parent, level))
        columns = {
            name: np.array([getattr(self._records[node], name) for node in range(len(tree.parent))])
            for name in NodeRecord.__dataclass_fields__
        }
        return LodTable(
            parent=tree.parent, **columns, model_id=model_id, offsets=self._model.anchors.offsets.shape[1]
        )  # fmt: skip

    def _keep(self, nodes: list[int], records: Iterator[NodeRecord]) -> None:
        for node, record in zip(nodes, records, strict=True):
            check_stop_requested()
            self._records[node] = record

    def _levels(self, inner: np.ndarray) -> Iterator[list[int]]:
        """The inner nodes, each after its children, as many at once as do not depend on each other."""
        height = np.zeros(len(self._tree.parent), int)
        for node in range(len(height) - 1, 0, -1):
            parent = self._tree.parent[node]
            height[parent] = max(height[parent], height[node] + 1)
        for level in range(1, height[0] + 1):
            yield inner[height[inner] == level].tolist()

    def _make_leaf(self, node: int) -> NodeRecord:
        file, kept = node_file(self._folder, node), anchors_file(self._folder, node)
        if (record := read_record(file)) is not None and kept.exists():
            return record
        rows = self._tree.rows(node)
        anchors = self._model.anchors.select(torch.from_numpy(rows))
        model = model_of_rows(self._model, anchors, torch.from_numpy(rows))
        save_anchors(kept, anchors, rows)
        gaussians, error = leaf_gaussians(model, self._cameras, float(self._tree.edge[node]))
        record = node_record(gaussians, error, model, ())
        save_node(file, gaussians, record)
        return record

    def _make_parent(self, node: int) -> NodeRecord:
        file = node_file(self._folder, node)
        if (record := read_record(file)) is not None:
            return record
        below = self._children[node]
        records = [self._records[child] for child in below]
        children = [load_node(node_file(self._folder, child)).float() for child in below]
        gaussians, error = parent_gaussians(children, records, float(self._tree.edge[node]))
        record = node_record(gaussians, error, None, records)
        save_node(file, gaussians, record)
        return record
