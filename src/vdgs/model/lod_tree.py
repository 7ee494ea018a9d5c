"""A level-of-detail tree that is open: which nodes a view is drawn from, and those nodes in bounded memory.

The root holds the whole scene in few merged Gaussians, each child a part of the square of its parent in finer ones, and
each leaf also the anchors themselves. A view is drawn from a cut through the tree: every node whose error falls below a
number of pixels while that of its parent does not, and the anchors of the leaves whose merged Gaussians are too coarse.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass
from functools import cache, reduce
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels import get_num_threads
from vdgs.kernels.constants import DILATION_PX2, FRUSTUM_MARGIN
from vdgs.model.anchors import Anchors
from vdgs.model.gaussians import NodeGaussians
from vdgs.model.lod_format import TREE_FILE
from vdgs.model.lod_nodes import LodTable, anchors_file, load_anchors, load_node, node_file

#: Nodes are kept mapped up to so many bytes: a picture at rest of the viewer takes up to 280 MB of them.
CACHE_BYTES = 320 << 20
#: The least distance of a camera from a node, as a part of the node's side.
MIN_DISTANCE = 0.25
#: What drawing an anchor costs, in merged Gaussians: it is decoded, and shows about six of its ten (measured).
ANCHOR_COST = 16
#: Beyond so many threads reading nodes would take more memory, not less time.
MAX_READERS = 4
#: Parts of a view in full detail: places of a leaf's box each way, pixels that count as an anchor, the least size.
BOX_SAMPLES, PART_PIXELS, MIN_PART_PX = 4, 25, 16

_Content = TypeVar("_Content")


@dataclass(frozen=True)
class LodCut:
    """Nodes that cover the scene in a view, each place once: some by their merged Gaussians, leaves by anchors."""

    nodes: tuple[int, ...]
    leaves: tuple[int, ...]


class LodTree:
    """The tree in a folder. Raises VdgsError where there is none or a damaged one."""

    def __init__(self, folder: Path, cache_bytes: int = CACHE_BYTES) -> None:
        self.folder, self.table = folder, LodTable.load(folder / TREE_FILE)
        self._cache = NodeCache(cache_bytes)
        self._is_leaf = self.table.anchors > 0
        self._parent = np.maximum(self.table.parent, 0)
        self._levels = _levels(self.table.parent)
        bounds = self.table.bounds
        self._nearest = MIN_DISTANCE * (bounds[:, 3:5] - bounds[:, :2]).max(1)

    @property
    def cached_bytes(self) -> int:
        """What the cached nodes take of their files."""
        return self._cache.bytes

    def errors_px(self, camera: Camera) -> Float[np.ndarray, " t"]:
        """How many pixels of a view the merged Gaussians of each node are off; never less than those of a child.

        At the nearest place of the node, but no nearer than a part of its side: what surrounds the camera is mostly
        farther away.
        """
        focal = max(camera.fx, camera.fy)
        if camera.model == "orthographic":
            return self.table.error * focal
        low, high = self.table.bounds[:, :3], self.table.bounds[:, 3:]
        nearest = np.clip(camera.position, low, high)
        distance = np.maximum(np.linalg.norm(nearest - camera.position, axis=1), self._nearest)
        errors: np.ndarray = self.table.error * focal / np.maximum(distance, NEAR_PLANE)
        for nodes in self._levels:
            np.maximum.at(errors, self._parent[nodes], errors[nodes])
        return errors

    def visible(self, camera: Camera) -> Bool[np.ndarray, " t"]:
        """Which nodes may show in a view: all but those of which `cull` would take no anchor."""
        low, high = self.table.bounds[:, :3].astype(np.float64), self.table.bounds[:, 3:].astype(np.float64)
        rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
        center, half = (low + high) / 2 @ rotation.T + translation, (high - low) / 2
        shown = center[:, 2] + half @ np.abs(rotation[2]) > NEAR_PLANE
        spare = 3 * DILATION_PX2**0.5 + 0.01
        pinhole = camera.model == "pinhole"
        for axis, focal, middle, size, whole in (
            (0, camera.fx, camera.cx, camera.width, camera.full_size[0]),
            (1, camera.fy, camera.cy, camera.height, camera.full_size[1]),
        ):
            stretch = np.hypot(1, FRUSTUM_MARGIN * 0.5 * whole / focal) if pinhole else 1.0
            blur = DILATION_PX2**0.5 * camera.photograph_pixel * (camera.fx * camera.fy) ** 0.5 / focal
            margin = 3.01 * (stretch * self.table.reach + blur) + 1e-6 * np.abs(center).max(1)
            for sign, edge in ((1, (size - middle + spare) / focal), (-1, (middle + spare) / focal)):
                # A place lies beyond this side of the picture where sign · x > edge · z, at a distance of 1 / focal.
                normal, offset = np.zeros(3), 0.0 if pinhole else edge
                normal[axis], normal[2] = sign, -edge if pinhole else 0.0
                shown &= center @ normal - half @ np.abs(normal @ rotation) - offset <= margin
        return shown

    def cut(self, camera: Camera, max_error_px: float) -> LodCut:
        """What a view is drawn from so that nothing is off by more than so many pixels; 0: all from anchors."""
        errors, visible = self.errors_px(camera), self.visible(camera)
        fine = errors <= max_error_px
        above = ~fine[self._parent]
        above[0] = True
        nodes = np.flatnonzero(visible & fine & above)
        return LodCut(tuple(nodes.tolist()), tuple(np.flatnonzero(visible & ~fine & self._is_leaf).tolist()))

    def cost(self, cut: LodCut) -> int:
        """What drawing a cut costs, in merged Gaussians."""
        table = self.table
        return int(table.gaussians[list(cut.nodes)].sum() + ANCHOR_COST * table.anchors[list(cut.leaves)].sum())

    def error_within(self, camera: Camera, least_px: float, max_cost: int) -> float:
        """The least error in pixels, from `least_px` on, at which a view costs at most so much; the root's own if
        even that costs more."""
        errors, visible = self.errors_px(camera), self.visible(camera)
        shown = np.where(visible, self.table.gaussians, 0)
        gain = np.zeros(len(shown))
        np.add.at(gain, self._parent[1:], shown[1:])
        gain += np.where(visible, ANCHOR_COST * self.table.anchors, 0) - shown
        order = np.argsort(-errors, kind="stable")
        costs = shown[0] + np.cumsum(gain[order])
        # Nodes are refined from the largest error on; the first that must not be is drawn as it is.
        over = np.flatnonzero((costs > max_cost) & visible[order])
        return max(least_px, float(errors[order[over[0]]])) if len(over) else least_px

    def parts_in_detail(self, camera: Camera, max_anchors: int) -> list[Camera]:
        """The parts of a view in which it is drawn from all anchors, from its middle on: in halves until each shows at
        most so many anchors, by where the boxes of the leaves lie, `PART_PIXELS` pixels counted as one."""
        low, high = np.split(self.table.bounds[self._is_leaf].astype(np.float64)[:, None], 2, axis=2)
        steps = (np.arange(BOX_SAMPLES) + 0.5) / BOX_SAMPLES
        shares = np.stack([*np.meshgrid(steps, steps), np.full((BOX_SAMPLES, BOX_SAMPLES), 0.5)], -1).reshape(-1, 3)
        pixels, depths = camera.project((low + shares * (high - low)).reshape(-1, 3))
        anchors = np.repeat(self.table.anchors[self._is_leaf] / len(shares), len(shares))
        in_front = depths > NEAR_PLANE
        parts = _halve((0, 0, camera.width, camera.height), pixels[in_front], anchors[in_front], max_anchors)
        found = [camera.cropped(*box) for box in parts]
        return sorted(found, key=lambda part: np.hypot(part.cx - part.width / 2, part.cy - part.height / 2))

    def with_own_cache(self, cache_bytes: int) -> LodTree:
        """The same tree, whose nodes do not take the place of those that this one keeps in memory."""
        other = copy(self)
        other._cache = NodeCache(cache_bytes)
        return other

    def gaussians(self, node: int) -> NodeGaussians:
        """The merged Gaussians of a node as its file has them: places in full, all else in half precision."""
        return self._cache.get(("nodes", node), lambda: load_node(node_file(self.folder, node)), content_bytes)

    def anchors(self, leaf: int) -> tuple[Anchors, Tensor]:
        """The anchors of a leaf, and their rows in the model, ascending."""
        file = anchors_file(self.folder, leaf)
        return self._cache.get(("anchors", leaf), lambda: load_anchors(file), lambda content: content_bytes(content[0]))

    def anchors_of(
        self, leaves: tuple[int, ...], drawn: Callable[[int], tuple[Anchors, Tensor]]
    ) -> tuple[Anchors, Tensor] | None:
        """The anchors of some leaves in the order of the model, and their rows there; of each leaf those of `drawn`."""
        parts = side_by_side(drawn, leaves)
        if not parts:
            return None
        rows, order = torch.cat([rows for _, rows in parts]).sort()
        return _joined(Anchors, [anchors for anchors, _ in parts]).select(order), rows


def side_by_side(drawn: Callable[[int], _Content], nodes: tuple[int, ...]) -> list[_Content]:
    """What some nodes draw, in their order: they are read, checked and faded on as many threads as kernels use."""
    if min(get_num_threads(), len(nodes)) <= 1:
        return [drawn(node) for node in nodes]
    return list(_readers(min(get_num_threads(), MAX_READERS)).map(drawn, nodes))


@cache
def _readers(count: int) -> ThreadPoolExecutor:
    """Threads that read nodes. They are kept: to start them for each part of a picture takes a tenth of its time."""
    return ThreadPoolExecutor(count, "vdgs-reader")


def _halve(
    box: tuple[int, int, int, int], pixels: Float[np.ndarray, "p 2"], weights: Float[np.ndarray, " p"], most: float
) -> Iterator[tuple[int, int, int, int]]:
    """The parts (left, top, right, bottom) of a box of pixels in which places weigh at most so much."""
    left, top, right, bottom = box
    width, height = right - left, bottom - top
    inside = ((pixels >= (left, top)) & (pixels < (right, bottom))).all(1)
    pixels, weights = pixels[inside], weights[inside]
    if max(width, height) <= MIN_PART_PX or weights.sum() + width * height / PART_PIXELS <= most:
        yield box
        return
    x, y = (left + right) // 2, (top + bottom) // 2
    halves = (
        [(left, top, x, bottom), (x, top, right, bottom)] if width >= height
        else [(left, top, right, y), (left, y, right, bottom)]
    )  # fmt: skip
    for half in halves:
        yield from _halve(half, pixels, weights, most)


def _levels(parent: Int[np.ndarray, " t"]) -> list[Int[np.ndarray, " n"]]:
    """The nodes by their depth in the tree, the deepest first, without the root."""
    depth = np.zeros(len(parent), int)
    for node in range(1, len(parent)):
        depth[node] = depth[parent[node]] + 1
    return [np.flatnonzero(depth == level) for level in range(depth.max(), 0, -1)]


class NodeCache:
    """Contents of nodes, up to so many bytes: those used longest ago go first."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes, self.bytes = max_bytes, 0
        self._held: OrderedDict[tuple[str, int], tuple[object, int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: tuple[str, int], load: Callable[[], _Content], size: Callable[[_Content], int]) -> _Content:
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key][0]  # type: ignore[return-value]
        content = load()
        with self._lock:
            if key not in self._held:
                self._held[key] = (content, size(content))
                self.bytes += self._held[key][1]
            while self.bytes > self._max_bytes and len(self._held) > 1:
                self.bytes -= self._held.popitem(last=False)[1][1]
        return content


_Kind = TypeVar("_Kind", NodeGaussians, Anchors)


def _joined(kind: type[_Kind], parts: list[_Kind]) -> _Kind:
    names = parts[0].tensors()
    return parts[0] if len(parts) == 1 else kind(**{n: torch.cat([p.tensors()[n] for p in parts]) for n in names})


def content_bytes(content: NodeGaussians | Anchors) -> int:
    """Memory that the tensors of a node take."""
    return reduce(lambda total, tensor: total + tensor.nbytes, content.tensors().values(), 0)
