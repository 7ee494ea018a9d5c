"""Blocks on the plane: core, widened boundary, and the owner of every place. Files in GeoJSON.

Coordinates are x, y of the ground frame, float64. The owner of a place depends on x and y alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.errors import RunError, check_kind
from vdgs.geometry.geodesy import geodetic_from_enu
from vdgs.geometry.ground_frame import GroundFrame
from vdgs.partition.polygon_lookup import BlockCores
from vdgs.system.atomic_files import write_json
from vdgs.system.documents import JsonObject

#: Tensors or arrays: what goes in comes out.
Places = TypeVar("Places", Tensor, np.ndarray)


def xy_positions(positions: Float[Tensor, "n 3"] | Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """x and y of anchors in float64, the form in which owners are looked up: the same bits have the same owner."""
    places = torch.from_numpy(positions) if isinstance(positions, np.ndarray) else positions
    return places[:, :2].double().cpu().numpy()


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

    def owner(self, points: Places) -> Places:
        """The block [n] int64 of every point [n, 2]: whose core holds it, else whose core is nearest (the first of
        equals).

        Raises ValueError for other shapes and if a point is not finite, TypeError for what is no array or tensor.
        """
        check_kind("points", points, np.ndarray, Tensor)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"points must be [n, 2], x and y, not {list(points.shape)}")
        if isinstance(points, Tensor):
            return torch.from_numpy(self.owner(points.detach().double().cpu().numpy())).to(points.device)
        return self._cores.nearest(points)

    @cached_property
    def _cores(self) -> BlockCores:
        return BlockCores([block.core for block in self.items])

    def in_expanded(
        self, index: int, points: Float[np.ndarray, "n 2"], owner: Int64[np.ndarray, " n"] | None = None
    ) -> Bool[np.ndarray, " n"]:
        """Which points belong to the widened block: inside its boundary, or owned by it (`owner`, if already known)."""
        boundary = self.items[index].expanded
        reached = (self.owner(points) if owner is None else owner) == index
        (west, south), (east, north) = np.array(boundary.bounds).reshape(2, 2)
        x, y = points[:, 0], points[:, 1]
        near = np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north) & ~reached)
        reached[near] = shapely.contains_xy(boundary, x[near], y[near])
        return reached


def rows_by_owner(owner: Int64[np.ndarray, " n"], blocks: int) -> list[Int64[np.ndarray, " _"]]:
    """The points that each of so many blocks owns, ascending. Sorted once: looked up for each block, thousands of
    blocks would take longer than their cut."""
    order = np.argsort(owner, kind="stable")
    bounds = np.searchsorted(owner[order], np.arange(blocks + 1))
    return [order[begin:end] for begin, end in pairwise(bounds)]


def save_blocks(
    path: Path,
    blocks: Blocks,
    properties: Sequence[Mapping[str, object]],
    scene_properties: Mapping[str, Any] | None = None,
) -> None:
    """Write cores and widened boundaries with `properties` of each block as a FeatureCollection, atomically.

    Coordinates keep all digits: blocks that are read own exactly what they owned before.
    """
    write_json(path, _feature_collection(blocks, properties) | dict(scene_properties or {}))


def save_blocks_wgs84(
    path: Path, blocks: Blocks, properties: Sequence[Mapping[str, object]], ground: GroundFrame
) -> None:
    """The same in longitude, latitude (RFC 7946), for maps: every corner at the height of the ground frame's origin.

    Longitudes run on past 180 degrees where a scene lies across the antimeridian.
    Raises ValueError if the frame is not georeferenced.
    """
    if ground.origin_geo is None:
        raise ValueError(f"the ground frame ({ground.description}) is not georeferenced: blocks have no longitude")
    origin, level_at = ground.origin_geo, ground.axes_origin

    def on_earth(shape: shapely.Polygon) -> shapely.Polygon:
        return shapely.orient_polygons(
            shapely.transform(shape, lambda points: _longitude_latitude(points, origin, level_at))
        )

    geographic = Blocks(tuple(Block(on_earth(block.core), on_earth(block.expanded)) for block in blocks.items))
    write_json(path, _feature_collection(geographic, properties))


def _longitude_latitude(
    points: Float[np.ndarray, "n 2"], origin: tuple[float, float, float], level_at: tuple[float, float]
) -> Float[np.ndarray, "n 2"]:
    """Degrees of points east and north of `origin` (lat deg, lon deg, alt m), at its height; the axes are east and
    north at `axes_origin` (lat deg, lon deg)."""
    geodetic = geodetic_from_enu(np.column_stack([points, np.zeros(len(points))]), origin, level_at)
    longitude = geodetic[:, 1]
    return np.column_stack([longitude + 360 * np.round((origin[1] - longitude) / 360), geodetic[:, 0]])


def _feature_collection(blocks: Blocks, properties: Sequence[Mapping[str, object]]) -> JsonObject:
    """The FeatureCollection of cores and widened boundaries."""
    features = [
        {
            "type": "Feature",
            "properties": {"block": index, "boundary": name, **properties[index]},
            "geometry": shapely.geometry.mapping(shape),
        }
        for index, block in enumerate(blocks.items)
        for name, shape in (("core", block.core), ("expanded", block.expanded))
    ]
    return {"type": "FeatureCollection", "features": features}


def load_blocks(path: Path) -> Blocks:
    """The inverse of `save_blocks`. Raises RunError if the file is missing or damaged."""
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        shapes = {(each["properties"]["block"], each["properties"]["boundary"]): _polygon(each) for each in features}
        count = max(1, len(features) // 2)
        return Blocks(tuple(Block(shapes[index, "core"], shapes[index, "expanded"]) for index in range(count)))
    except FileNotFoundError as error:
        raise RunError(f"{path}: is not there. Cut the scene first: vdgs partition RUN") from error
    except (OSError, ValueError, TypeError, AttributeError, LookupError, shapely.errors.ShapelyError) as error:
        raise RunError(f"{path}: is damaged ({error}). Cut the scene again: vdgs partition RUN") from error


def _polygon(feature: JsonObject) -> shapely.Polygon:
    """The polygon of a feature. Raises ValueError if it is another shape, empty, or holds numbers that are none."""
    shape = shapely.geometry.shape(feature["geometry"])
    if isinstance(shape, shapely.Polygon) and not shape.is_empty and np.isfinite(shapely.get_coordinates(shape)).all():
        return shape
    raise ValueError("a boundary is not a polygon")
