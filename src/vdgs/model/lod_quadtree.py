"""A quadtree over the ground plane: which anchors lie in which node.

Dimensions: n anchors, t nodes. The anchors of a node are neighbors in `order` (Morton order of x and y), so that those
of a leaf can be read in one piece.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

#: Bits of a cell's index along x and along y: anchors that share a cell of the finest grid stay together.
AXIS_BITS = 31


@dataclass(frozen=True, eq=False, kw_only=True)
class Quadtree:
    """Nodes, each after its parent; node 0 is the root."""

    #: Rows of the anchors, node by node; within a leaf they ascend.
    order: Int[np.ndarray, " n"]
    #: The anchors of a node: so many of `order` from here on.
    first: Int[np.ndarray, " t"]
    count: Int[np.ndarray, " t"]
    #: -1 of the root.
    parent: Int[np.ndarray, " t"]
    #: Side of the square of a node.
    edge: Float[np.ndarray, " t"]

    @property
    def is_leaf(self) -> Bool[np.ndarray, " t"]:
        leaves = np.ones(len(self.parent), bool)
        leaves[self.parent[1:]] = False
        return leaves

    def rows(self, node: int) -> Int[np.ndarray, " r"]:
        """The anchors of a node."""
        return self.order[self.first[node] : self.first[node] + self.count[node]]


def build_quadtree(positions: Float[np.ndarray, "n 3"], max_anchors: int) -> Quadtree:
    """Squares are cut in four until none holds more than `max_anchors`; cuts that part nothing are left out."""
    low = positions[:, :2].min(0).astype(np.float64)
    size = max(float((positions[:, :2].max(0) - low).max()), 1e-6)
    codes = _morton_codes(positions, low, size)
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    first, count, parent, edge = list[int](), list[int](), list[int](), list[float]()
    waiting = [(0, len(codes), -1, size)]
    while waiting:
        start, end, above, square = waiting.pop()
        node = len(first)
        level = _common_level(int(codes[start]), int(codes[end - 1]))
        split = end - start > max_anchors and level < AXIS_BITS
        first.append(start)
        count.append(end - start)
        parent.append(above)
        edge.append(size / 2**level if split else square)
        if not split:
            order[start:end] = np.sort(order[start:end])
            continue
        shift = 2 * (AXIS_BITS - level - 1)
        quarters = (int(codes[start]) >> (shift + 2) << 2) + np.arange(1, 4)
        cuts = start + np.searchsorted(codes[start:end], np.array([int(q) << shift for q in quarters], np.uint64))
        bounds = [start, *cuts.tolist(), end]
        for a, b in zip(bounds[-2::-1], bounds[:0:-1], strict=True):
            if a < b:
                waiting.append((a, b, node, size / 2 ** (level + 1)))
    return Quadtree(
        order=order, first=np.array(first), count=np.array(count), parent=np.array(parent), edge=np.array(edge)
    )


def _morton_codes(positions: np.ndarray, low: np.ndarray, size: float) -> UInt64[np.ndarray, " n"]:
    """The bits of x and y in turn."""
    codes = np.zeros(len(positions), np.uint64)
    for axis in (0, 1):
        cells = ((positions[:, axis] - low[axis]) / size * 2**AXIS_BITS).astype(np.int64)
        bits = cells.clip(0, 2**AXIS_BITS - 1).astype(np.uint64)
        for shift, mask in (
            (16, 0x0000FFFF0000FFFF), (8, 0x00FF00FF00FF00FF), (4, 0x0F0F0F0F0F0F0F0F),
            (2, 0x3333333333333333), (1, 0x5555555555555555),
        ):  # fmt: skip
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        codes |= bits << np.uint64(axis)
    return codes


def _common_level(first: int, last: int) -> int:
    """How often the whole square was cut in four to reach the smallest one that holds both."""
    return AXIS_BITS - ((first ^ last).bit_length() + 1) // 2
