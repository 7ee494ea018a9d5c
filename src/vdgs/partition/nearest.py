"""The core nearest to each of many places: whole cells of places are decided at once, only places near borders one by
one.

A cell of half-diagonal r about its centre c belongs to core k as a whole where every other core is farther from c than
k by more than 2 r. What is left is divided into smaller cells, until looking at the places themselves is cheaper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int64

#: A cell is divided into so many by so many.
DIVISION = 8
#: Cells that hold fewer places than this on average cost more than the places; and so few places need no cells.
PLACES_PER_CELL, FEW_PLACES = 8, 2_000
#: Rounding of coordinates and distances, as a share of the largest coordinate.
ROUNDING = 1e-13


@dataclass(frozen=True, eq=False)
class Cores:
    """Polygons on the plane without common area; at least one."""

    shapes: Sequence[shapely.Polygon]

    def nearest(self, places: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        """The core of every place: which holds it, else which is nearest; the first of equals.

        Raises ValueError if a place is not finite.
        """
        if not np.isfinite(places).all():
            raise ValueError("places that are not finite numbers have no owner")
        owner = np.full(len(places), 0 if len(self.shapes) == 1 else -1, np.int64)
        left = np.flatnonzero(owner < 0)
        if len(left) > FEW_PLACES:
            left = self._decide_cells(places, owner)
        owner[left] = self._one_by_one(places[left])
        return owner

    def _decide_cells(
        self, places: Float[np.ndarray, "n 2"], owner: Int64[np.ndarray, " n"]
    ) -> Int64[np.ndarray, " m"]:
        """Fill in `owner` for the places of cells that belong to one core; the indices of the others.

        The cells of the first round cover the box of all places, those of the next the undecided cells of the last.
        """
        low, high = places.min(axis=0), places.max(axis=0)
        edge = float((high - low).max())
        left, parents = np.arange(len(places)), np.zeros(len(places), np.int64)
        corners, candidates = low[None], np.ones((1, len(self.shapes)), bool)
        while edge > 1e3 * ROUNDING * np.abs(places).max():
            edge /= DIVISION
            within = ((places[left] - corners[parents]) / edge).astype(np.int64).clip(0, DIVISION - 1)
            cells, parents = _occupied(parents * DIVISION**2 + within[:, 0] * DIVISION + within[:, 1], len(corners))
            above, inner = np.divmod(cells, DIVISION**2)
            corners = corners[above] + edge * np.stack(np.divmod(inner, DIVISION), axis=1)
            candidates = self._candidates(corners + edge / 2, edge * np.sqrt(0.5), candidates[above])
            sole = candidates.sum(axis=1) == 1
            decided = sole[parents]
            owner[left[decided]] = candidates.argmax(axis=1)[parents[decided]]
            left, corners, candidates = left[~decided], corners[~sole], candidates[~sole]
            parents = (np.cumsum(~sole) - 1)[parents[~decided]]
            if len(left) < PLACES_PER_CELL * len(corners) * DIVISION:
                break
        return left

    def _candidates(
        self, centres: Float[np.ndarray, "c 2"], radius: float, candidates: Bool[np.ndarray, "c k"]
    ) -> Bool[np.ndarray, "c k"]:
        """Which of the candidates can be the nearest to a place within `radius` of each centre."""
        points = shapely.points(centres)
        distance = np.full(candidates.shape, np.inf)
        for index, shape in enumerate(self.shapes):
            asked = candidates[:, index]
            distance[asked, index] = shapely.distance(shape, points[asked])
        slack = 2 * radius + ROUNDING * (np.abs(centres).max(initial=0.0) + self._largest_coordinate)
        return distance <= distance.min(axis=1, keepdims=True) + slack

    def _one_by_one(self, places: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        owner = np.full(len(places), -1, np.int64)
        for index, shape in enumerate(self.shapes):
            free = np.flatnonzero(owner < 0)
            owner[free[shapely.contains_xy(shape, places[free, 0], places[free, 1])]] = index
        left = np.flatnonzero(owner < 0)
        edges, owners = self._edges
        pairs = edges.query_nearest(shapely.points(places[left]), all_matches=True)
        nearest = np.full(len(left), len(self.shapes), np.int64)
        np.minimum.at(nearest, pairs[0], owners[pairs[1]])
        owner[left] = nearest
        return owner

    @cached_property
    def _edges(self) -> tuple[shapely.STRtree, Int64[np.ndarray, " e"]]:
        """All edges of all cores, holes included, in a search tree; and whose they are."""
        segments, owners = [], []
        for index, shape in enumerate(self.shapes):
            for ring in (shape.exterior, *shape.interiors):
                corners = np.asarray(ring.coords)
                segments.append(shapely.linestrings(np.stack([corners[:-1], corners[1:]], axis=1)))
                owners.append(np.full(len(corners) - 1, index, np.int64))
        return shapely.STRtree(np.concatenate(segments)), np.concatenate(owners)

    @cached_property
    def _largest_coordinate(self) -> float:
        return float(np.abs(shapely.bounds(np.array(self.shapes, object))).max())


def _occupied(cell: Int64[np.ndarray, " n"], parents: int) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " n"]]:
    """The distinct cells in ascending order, and the position in them of each; np.unique without its sort."""
    there = np.zeros(parents * DIVISION**2, bool)
    there[cell] = True
    position = np.cumsum(there) - 1
    return np.flatnonzero(there), position[cell]
