"""`.rad`: Spark's file of a scene with its levels of detail, of which a page loads what it needs.

A tree of Gaussians: each has the range of its children, which it was merged from (`model.gaussian_merging`); rows stand
level by level, the root first, brothers beside each other. After `RAD0` and JSON come chunks of 65,536 rows, each
`RADC`, JSON and a deflated column for each quantity. Layout: version 1, as the encoder of Spark 2.2 (`rad.rs`) writes
it. The frame is y up.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from vdgs.export.formats.axes import Y_UP
from vdgs.export.formats.export_scene import (
    ExportScene,
    base_colors,
    concatenate,
    gaussian_scales,
    opacities,
    write_metadata_file,
)
from vdgs.model.gaussian_merging import group_neighbors, merge_by_moments
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_bytes
from vdgs.system.documents import JsonObject
from vdgs.system.stop_signals import check_stop_requested

#: Rows of a chunk: Spark's pager finds the chunk of a row by it.
CHUNK_ROWS = 65536
#: A level has this part of the Gaussians of the finer one.
LEVEL_RATIO = 4
_COEFFICIENTS = {"sh1": slice(0, 3), "sh2": slice(3, 8), "sh3": slice(8, 15)}


@dataclass(frozen=True, eq=False)
class GaussianTree:
    """Gaussians and those that they were merged into, each parent before its children."""

    gaussians: Gaussians
    #: How many children each has, and where they begin; 0 of both without.
    counts: Int[np.ndarray, " n"]
    starts: Int[np.ndarray, " n"]


def write_rad(path: Path, scene: ExportScene) -> tuple[str, ...]:
    """Write the file, atomically, and the scene's facts beside it. Returns what was lost. Raises VdgsError.

    Memory: 0.8 kB for each Gaussian.
    """
    axes = scene.axes or Y_UP
    tree = build_tree(concatenate(scene.pieces(axes)))
    count, degree = len(tree.counts), scene.degree
    chunks = [_chunk(tree, first, degree) for first in range(0, count, CHUNK_ROWS)]
    offsets = np.cumsum([0, *map(len, chunks)]).tolist()
    header: JsonObject = {
        "version": 1, "type": "gsplat", "count": count, "maxSh": degree, "lodTree": True, "chunkSize": CHUNK_ROWS,
        "allChunkBytes": offsets[-1], "comment": scene.metadata.program,
        "chunks": [{"offset": start, "bytes": len(chunk)} for start, chunk in zip(offsets, chunks, strict=False)],
    }  # fmt: skip
    write_bytes(path, b"".join([b"RAD0", *_framed(header), *chunks]))
    write_metadata_file(path, scene.metadata, axes)
    lost = ["colors, shapes and opacities are rounded to half precision"]
    if degree:
        lost.append("changing colors are rounded to 1/127 of the largest of their chunk")
    return tuple(lost)


def build_tree(gaussians: Gaussians) -> GaussianTree:
    """Merge a scene to a quarter again and again, down to one. What is alone in its group is no level of its own."""
    nodes, level, ids, links = [gaussians], gaussians, np.arange(len(gaussians)), []
    total = len(gaussians)
    while len(level) > 1:
        check_stop_requested()
        groups = group_neighbors(level, max(len(level) // LEVEL_RATIO, 1))
        merged = merge_by_moments(level, groups)
        sizes = np.bincount(groups)
        several = sizes > 1
        order = np.argsort(groups, kind="stable")
        above = ids[order[np.cumsum(sizes) - sizes]]
        above[several] = total + np.arange(np.count_nonzero(several))
        links.append((above[several], sizes[several], ids[order][np.repeat(several, sizes)]))
        nodes.append(merged.select(torch.from_numpy(several)))
        level, ids, total = merged, above, total + int(np.count_nonzero(several))
    return _ordered(concatenate(nodes), int(ids[0]), links)


def _ordered(gaussians: Gaussians, root: int, links: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> GaussianTree:
    """Nodes with the root first and children beside each other. `links`, from the finest level up: parents, how many
    children each has, and these."""
    total, filled = len(gaussians), 1
    places, counts, starts = (np.zeros(total, np.int64) for _ in range(3))
    places[root] = 0
    for parents, sizes, children in reversed(links):
        begins = np.cumsum(sizes) - sizes
        by_place = np.argsort(places[parents], kind="stable")
        shifted = np.empty(len(parents), np.int64)
        shifted[by_place] = filled + np.cumsum(sizes[by_place]) - sizes[by_place]
        places[children] = np.repeat(shifted - begins, sizes) + np.arange(len(children))
        counts[places[parents]], starts[places[parents]] = sizes, shifted
        filled += len(children)
    order = np.argsort(places)
    return GaussianTree(gaussians.select(torch.from_numpy(order)), counts, starts)


def _chunk(tree: GaussianTree, first: int, degree: int) -> bytes:
    rows = slice(first, first + CHUNK_ROWS)
    columns, properties, offset = list[bytes](), list[JsonObject](), 0
    for facts, values in _columns(tree, rows, degree):
        packer = zlib.compressobj(6, zlib.DEFLATED, -15)
        packed = packer.compress(values) + packer.flush()
        properties.append({"offset": offset, "bytes": len(packed), **facts, "compression": "gz"})
        columns.append(_padded(packed))
        offset += len(columns[-1])
    facts = {
        "version": 1, "base": first, "count": len(tree.counts[rows]), "payloadBytes": offset, "maxSh": degree,
        "lodTree": True, "properties": properties,
    }  # fmt: skip
    return b"".join([b"RADC", *_framed(facts), struct.pack("<Q", offset), *columns])


def _columns(tree: GaussianTree, rows: slice, degree: int) -> Iterator[tuple[JsonObject, bytes]]:
    """What is said of each quantity, and its numbers, one axis after the other."""
    part = tree.gaussians.select(torch.arange(len(tree.counts), device="cpu")[rows])
    places = np.ascontiguousarray(part.means.numpy().T.astype("<f4"))
    by_byte = places.view(np.uint8).reshape(*places.shape, 4).transpose(2, 0, 1)
    yield {"property": "center", "encoding": "f32_lebytes"}, by_byte.tobytes()
    quaternions = part.quaternions.numpy()
    quaternions = np.where(quaternions[:, :1] < 0, -quaternions, quaternions)
    for name, encoding, values in (
        ("alpha", "f16", opacities(part)[:, None]), ("rgb", "f16", base_colors(part)),
        ("scales", "ln_f16", np.log(np.maximum(gaussian_scales(part), 1e-30))),
        ("orientation", "f16", quaternions[:, 1:]),
    ):  # fmt: skip
        yield {"property": name, "encoding": encoding}, _halves(values)
    for name in list(_COEFFICIENTS)[:degree]:
        values = part.shN[:, _COEFFICIENTS[name]].flatten(1).numpy()
        largest = max(float(np.abs(values).max()), 1e-6)
        steps = np.rint(values / largest * 127).astype(np.int8)
        yield {"property": name, "encoding": "s8", "min": -largest, "max": largest}, steps.T.tobytes()
    yield {"property": "child_count", "encoding": "u16"}, tree.counts[rows].astype("<u2").tobytes()
    yield {"property": "child_start", "encoding": "u32"}, tree.starts[rows].astype("<u4").tobytes()


def _halves(values: Float[np.ndarray, "n k"]) -> bytes:
    return np.clip(values, -65504, 65504).astype("<f2").T.tobytes()


def _framed(facts: JsonObject) -> tuple[bytes, bytes]:
    """The length of JSON, and the JSON, padded."""
    content = json.dumps(facts, allow_nan=False).encode()
    return struct.pack("<I", len(content)), _padded(content)


def _padded(content: bytes) -> bytes:
    return content + bytes(-len(content) % 8)
