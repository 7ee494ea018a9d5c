"""Blocks on the plane: core, widened boundary, and the owner of every place. Files in GeoJSON.

Coordinates are x, y of the ground frame, float64. The owner of a place depends on x and y alone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int64

from vdgs.errors import RunError
from vdgs.files import write_text


@dataclass(frozen=True, eq=False)
class Block:
    """One block: the cores of all blocks are disjoint, and core lies in expanded."""

    core: shapely.Polygon
    expanded: shapely.Polygon


@dataclass(frozen=True, eq=False)
class Blocks:
    """All blocks of a scene; index in `items` is the number of the block."""

    items: tuple[Block, ...]

    def __len__(self) -> int:
        return len(self.items)

    def owner(self, places: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        """The block of every place: whose core holds it, else whose core is nearest (the first of equals).

        O(n) time and memory but for the search for the nearest edge, O(log) for each place that no core holds.
        """
        owner = np.full(len(places), -1, np.int64)
        for index, block in enumerate(self.items):
            free = np.flatnonzero(owner < 0)
            owner[free[shapely.contains_xy(block.core, places[free, 0], places[free, 1])]] = index
        left = np.flatnonzero(owner < 0)
        if len(left):
            owner[left] = self._nearest(places[left]) if len(self.items) > 1 else 0
        return owner

    def _nearest(self, places: Float[np.ndarray, "n 2"]) -> Int64[np.ndarray, " n"]:
        """The block of the nearest edge, for places inside no core; the first of equals."""
        edges, owners = self._edges
        pairs = edges.query_nearest(shapely.points(places), all_matches=True)
        nearest = np.full(len(places), len(self.items), np.int64)
        np.minimum.at(nearest, pairs[0], owners[pairs[1]])
        return nearest

    @cached_property
    def _edges(self) -> tuple[shapely.STRtree, Int64[np.ndarray, " e"]]:
        """All edges of all cores, holes included, in a search tree; and whose they are."""
        segments, owners = [], []
        for index, block in enumerate(self.items):
            for ring in (block.core.exterior, *block.core.interiors):
                corners = np.asarray(ring.coords)
                segments.append(shapely.linestrings(np.stack([corners[:-1], corners[1:]], axis=1)))
                owners.append(np.full(len(corners) - 1, index, np.int64))
        return shapely.STRtree(np.concatenate(segments)), np.concatenate(owners)

    def reaches(self, index: int, places: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Which places belong to the widened block: inside its boundary, or owned by it."""
        boundary = self.items[index].expanded
        return shapely.contains_xy(boundary, places[:, 0], places[:, 1]) | (self.owner(places) == index)


def save_blocks(path: Path, blocks: Blocks, facts: Sequence[dict[str, Any]]) -> None:
    """Write cores and widened boundaries as a FeatureCollection, atomically, with `facts` of each block.

    Coordinates keep all digits: what is read owns exactly what was written.
    """
    features = [
        {
            "type": "Feature",
            "properties": {"block": index, "boundary": name, **facts[index]},
            "geometry": shapely.geometry.mapping(shape),
        }
        for index, block in enumerate(blocks.items)
        for name, shape in (("core", block.core), ("expanded", block.expanded))
    ]
    write_text(path, json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n")


def load_blocks(path: Path) -> Blocks:
    """The inverse of `save_blocks`. Raises RunError if the file is missing or damaged."""
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        shapes: dict[tuple[int, str], shapely.Polygon] = {
            (each["properties"]["block"], each["properties"]["boundary"]): shapely.geometry.shape(each["geometry"])
            for each in features
        }
        return Blocks(
            tuple(Block(shapes[index, "core"], shapes[index, "expanded"]) for index in range(len(features) // 2))
        )
    except FileNotFoundError as error:
        raise RunError(f"{path}: is not there. Cut the scene first: vdgs partition RUN") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, shapely.errors.ShapelyError) as error:
        raise RunError(f"{path}: is damaged ({error}). Cut the scene again: vdgs partition RUN") from error
