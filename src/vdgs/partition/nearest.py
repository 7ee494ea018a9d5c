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
DIVISION = 4
#: Cells that would hold fewer places than this cost more than the places themselves.
PLACES_PER_CELL = 2
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
        owner = np.zeros(len(places), np.int64)
        if len(self.shapes) == 1:
            return owner
        # Far places apart from the others: a box that holds them all would have to be divided many times.
        far = ((places < self._box[0]) | (places > self._box[1])).any(axis=1)
        for some in (np.flatnonzero(~far), np.flatnonzero(far)):
            if len(some):
                owner[some] = self._nearest(places[some])
        return owner

    def _nearest(self, places: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        owner = np.full(len(places), -1, np.int64)
        left, candidates = self._decide_cells(places, owner)
        owner[left] = self._distances(places[left], candidates).argmin(axis=1)
        return owner

    def _decide_cells(
        self, places: Float[np.ndarray, "n 2"], owner: Int64[np.ndarray, " n"]
    ) -> tuple[Int64[np.ndarray, " m"], Bool[np.ndarray, "m k"]]:
        """Fill in `owner` for the places of cells that belong to one core; the indices and candidates of the others.

        The cells of the first round divide the box of all places, those of the next the undecided cells of the last.
        """
        low, high = places.min(axis=0), places.max(axis=0)
        edge, least = float((high - low).max()), 1e3 * ROUNDING * float(np.abs(places).max())
        left, parents = np.arange(len(places)), np.zeros(len(places), np.int64)
        corners, candidates = low[None], np.ones((1, len(self.shapes)), bool)
        while edge > least and len(left) > PLACES_PER_CELL * len(corners) * DIVISION**2:
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
        return left, candidates[parents]

    def _candidates(
        self, centres: Float[np.ndarray, "c 2"], radius: float, candidates: Bool[np.ndarray, "c k"]
    ) -> Bool[np.ndarray, "c k"]:
        """Which of the candidates can be the nearest to a place within `radius` of each centre."""
        distance = self._distances(centres, candidates)
        slack = 2 * radius + ROUNDING * (np.abs(centres).max() + np.abs(self._box).max())
        return distance <= distance.min(axis=1, keepdims=True) + slack

    def _distances(
        self, places: Float[np.ndarray, "n 2"], candidates: Bool[np.ndarray, "n k"]
    ) -> Float[np.ndarray, "n k"]:
        """From every place to its candidates, 0 inside; infinite to all other cores."""
        points = shapely.points(places)
        distance = np.full(candidates.shape, np.inf)
        for index, shape in enumerate(self.shapes):
            asked = np.flatnonzero(candidates[:, index])
            # Whether a core holds a place is asked much faster than how far it is.
            held = shapely.contains_xy(shape, places[asked])
            distance[asked[held], index] = 0.0
            distance[asked[~held], index] = shapely.distance(self._edges[index], points[asked[~held]])
        return distance

    @cached_property
    def _edges(self) -> list[shapely.Geometry]:
        """The edges of each core, holes included."""
        return [shape.boundary for shape in self.shapes]

    @cached_property
    def _box(self) -> Float[np.ndarray, "2 2"]:
        """Low and high corner of the box of all cores, widened by its own size to every side."""
        low, high = shapely.total_bounds(np.array(self.shapes, object)).reshape(2, 2)
        return np.stack([2 * low - high, 2 * high - low])


def _occupied(cell: Int64[np.ndarray, " n"], parents: int) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " n"]]:
    """The distinct cells in ascending order, and the position in them of each; np.unique without its sort."""
    there = np.zeros(parents * DIVISION**2, bool)
    there[cell] = True
    position = np.cumsum(there) - 1
    return np.flatnonzero(there), position[cell]
