"""Finds the core nearest to each of many points: whole cells of points at once, only points near borders one by one.

A cell of half-diagonal r around its center c belongs to core k as a whole where every other core is farther from c than
k by more than 2 r. The other cells are divided, until testing their points is cheaper. The candidate cores of cells and
points are pairs, sorted by cell or point and then by core: few cores are near one point, however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Int64

#: A cell is divided into so many by so many.
SUBDIVISION = 4
#: Cells that would hold fewer places than this cost more than the places themselves.
POINTS_PER_CELL = 2
#: Rounding of coordinates and distances, as a share of the largest coordinate.
RELATIVE_TOLERANCE = 1e-13


class _CandidatePairs(NamedTuple):
    """Cells or places by number, and the cores that are asked of each: ascending by `of`, then by `core`."""

    of: Int64[np.ndarray, " p"]
    core: Int64[np.ndarray, " p"]

    def starts(self) -> Int64[np.ndarray, " c"]:
        """Where the pairs of each cell or place begin; each has at least one."""
        return np.flatnonzero(np.diff(self.of, prepend=-1))

    def inherited(self, parents: Int64[np.ndarray, " c"], count: int) -> _CandidatePairs:
        """The pairs of the children, in the order in which `parents` names their parents out of `count`."""
        sizes = np.bincount(self.of, minlength=count)
        begins = (np.cumsum(sizes) - sizes)[parents]
        sizes = sizes[parents]
        ends = np.cumsum(sizes)
        rank = np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - sizes, sizes)
        return _CandidatePairs(np.repeat(np.arange(len(parents)), sizes), self.core[np.repeat(begins, sizes) + rank])


@dataclass(frozen=True, eq=False)
class BlockCores:
    """Polygons on the plane without common area; at least one."""

    shapes: Sequence[shapely.Polygon]

    def nearest(
        self, points: Float[np.ndarray, "n 2"], among: Int64[np.ndarray, " k"] | None = None
    ) -> Int64[np.ndarray, " n"]:
        """The core of every point: which holds it, else which is nearest; the first of equals. `among`: the cores to
        consider, ascending; by default all. Raises ValueError if a point is not finite.
        """
        if not np.isfinite(points).all():
            raise ValueError("places that are not finite numbers have no owner")
        candidates = np.arange(len(self.shapes)) if among is None else among
        owner = np.full(len(points), candidates[0], np.int64)
        if len(candidates) == 1:
            return owner
        # Far places apart from the others: a box that holds them all would have to be divided many times.
        far = ((points < self._box[0]) | (points > self._box[1])).any(axis=1)
        for some in (np.flatnonzero(~far), np.flatnonzero(far)):
            if len(some):
                owner[some] = self._nearest(points[some], candidates)
        return owner

    def _nearest(
        self, points: Float[np.ndarray, "n 2"], candidates: Int64[np.ndarray, " k"]
    ) -> Int64[np.ndarray, " n"]:
        owner = np.full(len(points), -1, np.int64)
        left, pairs = self._decide_cells(points, owner, candidates)
        if len(left):
            owner[left] = self._first_nearest(points[left], pairs)
        return owner

    def _decide_cells(
        self, points: Float[np.ndarray, "n 2"], owner: Int64[np.ndarray, " n"], candidates: Int64[np.ndarray, " k"]
    ) -> tuple[Int64[np.ndarray, " m"], _CandidatePairs]:
        """Fill in `owner` for the places of cells that belong to one core; the indices and candidates of the others.

        The cells of the first round divide the box of all places, those of the next the undecided cells of the last.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        edge, least = float((high - low).max()), 1e3 * RELATIVE_TOLERANCE * float(np.abs(points).max())
        left, parents = np.arange(len(points)), np.zeros(len(points), np.int64)
        candidates = self._about(low, high, candidates)
        corners, pairs = low[None], _CandidatePairs(np.zeros(len(candidates), np.int64), candidates)
        while edge > least and len(left) > POINTS_PER_CELL * len(corners) * SUBDIVISION**2:
            edge /= SUBDIVISION
            within = ((points[left] - corners[parents]) / edge).astype(np.int64).clip(0, SUBDIVISION - 1)
            cells, parents = _occupied(
                parents * SUBDIVISION**2 + within[:, 0] * SUBDIVISION + within[:, 1], len(corners)
            )
            above, inner = np.divmod(cells, SUBDIVISION**2)
            pairs = pairs.inherited(above, len(corners))
            corners = corners[above] + edge * np.stack(np.divmod(inner, SUBDIVISION), axis=1)
            pairs = self._candidates(corners + edge / 2, edge * np.sqrt(0.5), pairs)
            starts = pairs.starts()
            sole = np.diff(starts, append=len(pairs.of)) == 1
            decided = sole[parents]
            owner[left[decided]] = pairs.core[starts][parents[decided]]
            renumbered = np.cumsum(~sole) - 1
            open_pairs = ~sole[pairs.of]
            pairs = _CandidatePairs(renumbered[pairs.of[open_pairs]], pairs.core[open_pairs])
            left, corners = left[~decided], corners[~sole]
            parents = renumbered[parents[~decided]]
        return left, pairs.inherited(parents, len(corners))

    def _about(
        self, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], candidates: Int64[np.ndarray, " k"]
    ) -> Int64[np.ndarray, " some"]:
        """Those of the cores that can be the nearest to a place of a box, by their own boxes alone."""
        lows, highs = self._boxes[candidates, :2], self._boxes[candidates, 2:]
        least = np.linalg.norm(np.maximum(np.maximum(lows - high, low - highs), 0.0), axis=1)
        most = np.linalg.norm(np.maximum(highs - low, high - lows), axis=1)
        return candidates[least <= most.min() * (1 + 1e-9) + RELATIVE_TOLERANCE * np.abs(self._box).max()]

    def _candidates(self, centers: Float[np.ndarray, "c 2"], radius: float, pairs: _CandidatePairs) -> _CandidatePairs:
        """Those of the pairs whose core can be the nearest to a place within `radius` of its cell's center."""
        distance = self._distances(centers, pairs)
        slack = 2 * radius + RELATIVE_TOLERANCE * (np.abs(centers).max() + np.abs(self._box).max())
        near = distance <= np.minimum.reduceat(distance, pairs.starts())[pairs.of] + slack
        return _CandidatePairs(pairs.of[near], pairs.core[near])

    def _first_nearest(self, points: Float[np.ndarray, "n 2"], pairs: _CandidatePairs) -> Int64[np.ndarray, " n"]:
        """The first of the cores that are nearest to each place."""
        distance = self._distances(points, pairs)
        nearest = np.flatnonzero(distance == np.minimum.reduceat(distance, pairs.starts())[pairs.of])
        return pairs.core[nearest[np.diff(pairs.of[nearest], prepend=-1) > 0]]

    def _distances(self, points: Float[np.ndarray, "n 2"], pairs: _CandidatePairs) -> Float[np.ndarray, " p"]:
        """From the place of each pair to its core, 0 inside."""
        distance = np.zeros(len(pairs.of))
        # A core at a time: whether it holds a place is asked of a prepared one, much faster than how far it is.
        order = np.argsort(pairs.core, kind="stable")
        cores, begins = np.unique(pairs.core[order], return_index=True)
        for core, rows in zip(cores.tolist(), np.split(order, begins[1:]), strict=True):
            asked = points[pairs.of[rows]]
            outside = ~shapely.contains_xy(self.shapes[core], asked)
            distance[rows[outside]] = shapely.distance(self._edges[core], shapely.points(asked[outside]))
        return distance

    @cached_property
    def _edges(self) -> list[shapely.Geometry]:
        """The edges of each core, holes included."""
        return [shape.boundary for shape in self.shapes]

    @cached_property
    def _boxes(self) -> Float[np.ndarray, "k 4"]:
        """Low x and y, high x and y of each core."""
        return np.asarray(shapely.bounds(np.array(self.shapes, object)), np.float64)

    @cached_property
    def _box(self) -> Float[np.ndarray, "2 2"]:
        """Low and high corner of the box of all cores, widened by its own size to every side."""
        low, high = shapely.total_bounds(np.array(self.shapes, object)).reshape(2, 2)
        return np.stack([2 * low - high, 2 * high - low])


def _occupied(cell: Int64[np.ndarray, " n"], parents: int) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " n"]]:
    """The distinct cells in ascending order, and the position in them of each; np.unique without its sort."""
    there = np.zeros(parents * SUBDIVISION**2, bool)
    there[cell] = True
    position = np.cumsum(there) - 1
    return np.flatnonzero(there), position[cell]
