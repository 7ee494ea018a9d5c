"""The files of a level-of-detail tree: a table of its nodes, and for each node what it draws.

tree.safetensors        the table, written last: a folder without it holds a tree that is not finished
nodes/N.safetensors     the merged Gaussians of node N
anchors/N.safetensors   the anchors of leaf N, with their rows in the model
"""

from __future__ import annotations

import json
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.model.anchors import Anchors
from vdgs.model.gaussians import NodeGaussians
from vdgs.model.lod_format import LOD_FORMAT, NODE_FORMAT
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import map_tensors, read_tensors, tensors_crc32, write_tensors

#: What to do about a tree that cannot be used.
REBUILD_HINT = "Delete that folder and make the tree again: vdgs lod RUN"


@dataclass(frozen=True, eq=False, kw_only=True)
class LodTable:
    """What a tree says of its t nodes, each after its parent; node 0 is the root."""

    parent: Int[np.ndarray, " t"]
    #: How far from their true places merged Gaussians draw things: units of the ground frame (root mean square).
    #: Never 0, and never less than that of a child.
    error: Float[np.ndarray, " t"]
    #: Lower and upper corner of the box of all centers.
    bounds: Float[np.ndarray, "t 6"]
    #: The largest standard deviation of a merged Gaussian, or of an anchor's place.
    reach: Float[np.ndarray, " t"]
    gaussians: Int[np.ndarray, " t"]
    #: 0 of inner nodes.
    anchors: Int[np.ndarray, " t"]
    #: `file_id` of the model that the tree belongs to, and Gaussians that an anchor spawns.
    model_id: str
    offsets: int

    def __len__(self) -> int:
        return len(self.parent)

    def save(self, path: Path) -> None:
        tensors = {name: torch.from_numpy(np.ascontiguousarray(getattr(self, name), kind)) for name, kind in _COLUMNS}
        content = {"model": self.model_id, "offsets": self.offsets, "crc32": tensors_crc32(tensors)}
        write_atomic(path, lambda file: write_tensors(file, tensors, {LOD_FORMAT: json.dumps(content)}))

    @staticmethod
    def load(path: Path) -> LodTable:
        """Raises VdgsError for a file that is missing, damaged or no table."""
        if not path.exists():
            raise VdgsError(f"{path.parent}: holds no finished level-of-detail tree. Make it: vdgs lod RUN")
        tensors, header = read_tensors(path)
        if LOD_FORMAT not in header and any(key.startswith("vdgs-lod-") for key in header):
            raise VdgsError(f"{path.parent}: is of another version of vdgs. Make it again: vdgs lod RUN")
        try:
            content = json.loads(header[LOD_FORMAT])
            if content["crc32"] != tensors_crc32(tensors):
                raise ValueError("its checksum does not agree")
            columns = {name: tensors[name].numpy() for name, _ in _COLUMNS}
            return LodTable(**columns, model_id=str(content["model"]), offsets=int(content["offsets"]))
        except (KeyError, ValueError, TypeError) as error:
            raise VdgsError(f"{path}: is damaged, or no level-of-detail tree ({error}). {REBUILD_HINT}") from error


_COLUMNS = (
    ("parent", np.int32), ("error", np.float32), ("bounds", np.float32), ("reach", np.float32),
    ("gaussians", np.int32), ("anchors", np.int32),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NodeRecord:
    """What the file of a node says of it: its row of the table."""

    error: float
    bounds: tuple[float, ...]
    reach: float
    gaussians: int
    anchors: int


def node_file(folder: Path, node: int) -> Path:
    return folder / "nodes" / f"{node:06d}.safetensors"


def anchors_file(folder: Path, node: int) -> Path:
    return folder / "anchors" / f"{node:06d}.safetensors"


def save_node(path: Path, gaussians: NodeGaussians, record: NodeRecord) -> None:
    """Write the merged Gaussians of a node: places in full, all else in half precision."""
    tensors = {name: t.half() if name != "means" else t for name, t in gaussians.tensors().items()}
    content = {**vars(record), "crc32": tensors_crc32(tensors)}
    write_atomic(path, lambda file: write_tensors(file, tensors, {NODE_FORMAT: json.dumps(content)}))


def load_node(path: Path) -> NodeGaussians:
    """The merged Gaussians of a node as they were saved, places alone in full precision. Raises VdgsError for a damaged
    file."""
    return NodeGaussians(**_read(path, NodeGaussians))


def save_anchors(path: Path, anchors: Anchors, rows: Int[np.ndarray, " r"]) -> None:
    """Write the anchors of a leaf, and their rows in the model."""
    tensors = {**anchors.tensors(), "rows": torch.from_numpy(rows.astype(np.int32))}
    content = {"crc32": tensors_crc32(tensors)}
    write_atomic(path, lambda file: write_tensors(file, tensors, {NODE_FORMAT: json.dumps(content)}))


def load_anchors(path: Path) -> tuple[Anchors, Int[Tensor, " r"]]:
    """The anchors of a leaf and their rows in the model. Raises VdgsError for a damaged file."""
    tensors = _read(path, Anchors)
    rows = tensors.pop("rows")
    return Anchors(**tensors), rows


def read_record(path: Path) -> NodeRecord | None:
    """The record in the header of a node's file; None where there is no such file, or another one."""
    try:
        content = _header(path)
        values = {name: content[name] for name in NodeRecord.__dataclass_fields__}
        return NodeRecord(**values | {"bounds": tuple(values["bounds"])})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _header(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        size = int.from_bytes(file.read(8), "little")
        if size > path.stat().st_size:
            raise ValueError("it has no header")
        content: dict[str, Any] = json.loads(json.loads(file.read(size))["__metadata__"][NODE_FORMAT])
        return content


def _read(path: Path, kind: type[NodeGaussians] | type[Anchors]) -> dict[str, Tensor]:
    try:
        tensors, metadata = map_tensors(path)
        if json.loads(metadata[NODE_FORMAT])["crc32"] != tensors_crc32(tensors):
            raise ValueError("its checksum does not agree")
        if missing := {each.name for each in fields(kind) if each.default is MISSING} - set(tensors):
            raise ValueError(f"it has no {', '.join(sorted(missing))}")
        return tensors
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError) as error:
        raise VdgsError(f"{path}: is missing or damaged ({error}). {REBUILD_HINT}") from error
