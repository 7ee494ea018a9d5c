"""The one operation by which places on Earth come to a system of the EPSG catalogue, and come back.

PROJ knows several between most datums, which differ by metres. Surveyed points that come in a system and maps that go
out in it must take the same: it is chosen here, by the system and the place alone.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float

from vdgs.geometry.geodesy import FLATTENING, SEMI_MAJOR_M

#: All operations start from here: latitude, longitude and height above the ellipsoid.
_WGS84 = "EPSG:4979"
#: Half the side of the area, in degrees, for which operations are asked where those for the whole system have none.
_AREA_DEG = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class DatumOperation:
    """The way between WGS 84 and a system, for one scene."""

    #: From WGS 84 to the system: longitude first and east first, or both in the order of the system's own axes.
    _transformer: Any
    latitude_first: bool
    is_ballpark: bool
    """Whether PROJ takes latitude and longitude for those of the other datum, or heights for those of the geoid."""
    made_for: str
    """The area that it is made for, where that is elsewhere; empty where it is made for the place."""
    accuracy_m: float
    """As the catalogue states it; infinite where it does not."""
    missing_grids: tuple[str, ...]
    """Of better operations that PROJ knows for the place, the files that are not at hand."""

    def from_geodetic(self, geodetic: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """(latitude deg, longitude deg, ellipsoidal height m) to coordinates of the system; inf out of reach. Heights
        of a system without heights stay metres above the ellipsoid."""
        latitude, longitude, height = geodetic.T
        first = (latitude, longitude) if self.latitude_first else (longitude, latitude)
        return np.stack(self._transformer.transform(*first, height), axis=1)

    def to_geodetic(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The inverse of `from_geodetic`."""
        # Between datums of two dimensions PROJ inverts to a millimetre only; once more, what is missing is a nanometre.
        with np.errstate(invalid="ignore"):  # out of reach
            missed = points - self.from_geodetic(self._inverted(points))
        return self._inverted(points + missed)

    def _inverted(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        first, second, height = self._transformer.transform(*points.T, direction="INVERSE")
        place = (first, second) if self.latitude_first else (second, first)
        return np.stack([*place, height], axis=1)


class NoOperation(ValueError):
    """PROJ cannot compute the coordinates of a system."""


def operation_at(crs: Any, latitude: float, longitude: float, own_axes: bool = False) -> DatumOperation:
    """The operation for a scene about a place (WGS 84, degrees): of those that are made for it the most accurate, of
    equal ones that in whose area it lies most in the middle; else the nearest that moves places; else none at all.

    The one operation serves the whole scene: asked point by point, PROJ may change it in between.
    Raises NoOperation.
    """
    return _operation_at(crs, round(latitude, 4), round(longitude, 4), own_axes)  # kept for ten metres


@lru_cache(maxsize=256)
def _operation_at(crs: Any, latitude: float, longitude: float, own_axes: bool) -> DatumOperation:
    known, better = _operations(crs, own_axes)
    there = _usable(known, latitude, longitude, own_axes)
    if not there:
        near, missing = _operations(crs, own_axes, round(latitude, 1), round(longitude, 1))
        there, known, better = _usable(near, latitude, longitude, own_axes), (*known, *near), (*better, *missing)
    if not there and (by_hub := _by_hub(crs, latitude, longitude, own_axes)) is not None:
        known = (*known, by_hub)
        there = _usable([by_hub], latitude, longitude, own_axes)
    made_for, shifts = "", [way for way in known if not is_ballpark(way)]
    if there:
        found = min(there, key=lambda way: (_accuracy(way), _off_center(way, latitude, longitude)))
    elif shifts:
        found = min(shifts, key=lambda way: (_off_center(way, latitude, longitude), _accuracy(way)))
        made_for = found.area_of_use.name if found.area_of_use else "elsewhere"
    elif known:
        found = known[0]
    else:
        raise NoOperation(f"PROJ knows no way from WGS 84 to {crs.name}")
    needed = [way for way in better if _is_for(way, latitude, longitude) and _accuracy(way) < _accuracy(found)]
    grids = {grid.short_name for way in needed for grid in way.grids if not grid.available}
    return DatumOperation(
        _transformer=found, latitude_first=own_axes, is_ballpark=is_ballpark(found), made_for=made_for,
        accuracy_m=_accuracy(found), missing_grids=tuple(sorted(grids)),
    )  # fmt: skip


def is_near_wgs84(crs: Any) -> bool:
    """Whether a datum without a known shift has the shape of WGS 84 or GRS 80: these agree to a metre or two."""
    shape = crs.ellipsoid
    if shape is None:
        return False
    longer, flatter = shape.semi_major_metre - SEMI_MAJOR_M, shape.inverse_flattening - 1 / FLATTENING
    return abs(longer) < 1 and abs(flatter) < 0.01


@lru_cache(maxsize=256)
def _operations(
    crs: Any, own_axes: bool, latitude: float | None = None, longitude: float | None = None
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """What PROJ has from WGS 84 to a system, and what it would have with grids that are not at hand: for the whole
    system, or about a place."""
    from pyproj.aoi import AreaOfInterest
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    area: Any = None
    if latitude is not None and longitude is not None:
        area = AreaOfInterest(
            longitude - _AREA_DEG, max(latitude - _AREA_DEG, -90), longitude + _AREA_DEG, min(latitude + _AREA_DEG, 90)
        )
    with warnings.catch_warnings():  # of grids that are not at hand: said in words
        warnings.simplefilter("ignore", UserWarning)
        try:
            group = TransformerGroup(_WGS84, crs, always_xy=not own_axes, area_of_interest=area)
        except IndexError:  # pyproj, where PROJ knows a projection but not how to compute it
            raise NoOperation(f"PROJ cannot compute coordinates of {crs.name}") from None
        except ProjError:  # PROJ, of places far from where a system is used (ETRS89 outside of Europe)
            return (), ()
    return tuple(group.transformers), tuple(group.unavailable_operations)


def _by_hub(crs: Any, latitude: float, longitude: float, own_axes: bool) -> Any | None:
    """The operation that PROJ finds by a third datum (ETRS89), which it looks for where no direct one is usable; None
    where there is none."""
    import pyproj

    place = (latitude, longitude) if own_axes else (longitude, latitude)
    try:
        ways = _transformer_by_hub(crs, own_axes)
        ways.transform(*place, 0.0)
        found = ways.get_last_used_operation()
    except pyproj.exceptions.ProjError:
        return None
    return None if is_ballpark(found) else found


@lru_cache(maxsize=64)
def _transformer_by_hub(crs: Any, own_axes: bool) -> Any:
    import pyproj

    return pyproj.Transformer.from_crs(_WGS84, crs, always_xy=not own_axes, allow_ballpark=False)


def _usable(ways: Any, latitude: float, longitude: float, own_axes: bool) -> list[Any]:
    """The operations that move places and are made for this one, which their grids hold."""
    place = (latitude, longitude) if own_axes else (longitude, latitude)
    return [
        way
        for way in ways
        if not is_ballpark(way)
        and _is_for(way, latitude, longitude)
        and np.isfinite(way.transform(*place, 0.0)[:2]).all()
    ]


def is_ballpark(operation: Any) -> bool:
    """Whether an operation of PROJ leaves out the shift of a datum, or that of heights to a geoid."""
    return "ballpark" in operation.description.lower()


def _accuracy(operation: Any) -> float:
    return float(operation.accuracy) if operation.accuracy >= 0 else float("inf")


def _is_for(operation: Any, latitude: float, longitude: float) -> bool:
    return operation.area_of_use is None or is_inside(operation.area_of_use, latitude, longitude)


def _off_center(operation: Any, latitude: float, longitude: float) -> float:
    """How far a place lies from the middle of the area of an operation, in halves of the area: above 1 outside."""
    area = operation.area_of_use
    if area is None:
        return 1.0
    wide = (area.east - area.west) % 360 or 360.0
    across = abs((longitude - area.west - wide / 2 + 180) % 360 - 180) / (wide / 2)
    along = abs(latitude - (area.north + area.south) / 2) / max((area.north - area.south) / 2, 1e-9)
    return float(max(across, along))


def is_inside(area: Any, latitude: float, longitude: float) -> bool:
    """Whether a place lies in an area of use of PROJ, across the antimeridian too."""
    whole = abs(area.east - area.west) >= 360
    across = whole or (longitude - area.west) % 360 <= (area.east - area.west) % 360
    return bool(across and area.south <= latitude <= area.north)


def meters_outside(area: Any, latitude: float, longitude: float) -> float:
    """How far a place lies from the nearest one (nearly) in an area of use of PROJ, in metres; 0 inside."""
    if is_inside(area, latitude, longitude):
        return 0.0
    import pyproj

    north, east = min(max(latitude, area.south), area.north), longitude
    if not is_inside(area, north, longitude):
        east = min((area.west, area.east), key=lambda edge: abs((longitude - edge + 180) % 360 - 180))
    return float(pyproj.Geod(ellps="WGS84").inv(longitude, latitude, east, north)[2])
