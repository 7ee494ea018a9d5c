"""Coordinate systems by the names that lists and tables give them: codes, ODM's words, PROJ strings, WKT."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
from jaxtyping import Float

from vdgs.captures.system_names import AROUND, pyproj_name
from vdgs.errors import CaptureError
from vdgs.geometry.datum_operation import (
    DatumOperation,
    NoOperation,
    is_ballpark,
    is_near_wgs84,
    meters_outside,
    operation_at,
)
from vdgs.geometry.geodesy import geodetic_from_ecef, median_place

ToGeodetic = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]
#: What stands for a system of heights beside a code, and is no code.
_UNKNOWN_HEIGHTS = re.compile(r"(?:EPSG|SRID)[\s:=_-]{0,3}\d{4,6}\+(?!\d)([^\s,;]+)$", re.I)
#: Zones and national systems are used so far beside the area that they are made for (choice).
BESIDE_DEG = 3.0
#: Places that differ by less than this are of one flight in degrees, and one place in metres.
_ONE_PLACE = 0.2
#: What is said of systems in feet, where nothing says the unit of heights.
HEIGHTS_IN_METERS = "; x and y in feet, heights are taken as metres"
ALL_IN_FEET = "; x, y and heights in feet"
#: What is said of heights above a geoid whose grid is not at hand.
WITHOUT_GEOID = "; heights as they are, for PROJ lacks the grid of their geoid"
#: National datums of which nothing more is known differ from WGS 84 by up to so many metres.
UNKNOWN_DATUM_M = 300.0
#: By how many metres places may be off that a shift for a neighbouring country brought (choice).
ELSEWHERE_M = 50.0
#: A datum that moves places by less (degrees) is WGS 84 for PROJ.
_SAME_DEG = 1e-8
#: Systems are used so far outside of the area that they are made for (metres): a zone for a whole country (choice).
OUTSIDE_M = 600_000.0
#: Ellipsoids of datums that agree with WGS 84 to a metre or two.
_GLOBAL = {"WGS 84", "GRS 1980"}


class UnknownSystem(CaptureError):
    """A coordinate system that PROJ does not know, by its definition."""

    def __init__(self, message: str, definition: str) -> None:
        super().__init__(message)
        self.definition = definition


def to_geodetic(
    header: str, file: Path, where: str = "the first line", *, heights_as_xy: bool = False, own_axes: bool = False
) -> tuple[ToGeodetic, str]:
    """What brings x, y, z [n, 3] (x east or longitude; `own_axes`: in the order of the system's own axes) to latitude,
    longitude and height, and the name of their system, which `header` names; `where` that stands in the file. Where the
    system has no heights, z is metres, or `heights_as_xy` in the unit of x and y of a projected system.

    Raises UnknownSystem, and CaptureError without pyproj.
    """
    try:
        import pyproj
    except ImportError:
        raise CaptureError(f"{file}: needs pyproj: pip install 'vdgs[geo]'.") from None
    crs = None
    try:
        crs = pyproj.CRS.from_user_input(pyproj_name(header))
        flat = len(crs.axis_info) == 2
        change = _to_latitude(crs, "EPSG:4326" if flat else "EPSG:4979", own_axes)
        up = _unit_without_heights(crs) if heights_as_xy else 1.0
    except pyproj.exceptions.ProjError:
        raise _unknown_system(crs, header, file, where) from None
    shifted = _Shifted(crs, own_axes, file)

    def changed(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        x, y, z = places.T
        if crs.is_projected and look_like_degrees(places[:, :2]):
            raise CaptureError(
                f"{file}: coordinates such as {x[0]:.10g}, {y[0]:.10g} look like degrees, but {crs.name} ({where}) "
                "counts in metres. Write the system that they are of, such as EPSG:4326 with longitude before latitude."
            )
        if _is_exchanged(crs, change, x, y):
            raise CaptureError(
                f"{file}: coordinates such as {x[0]:.10g}, {y[0]:.10g} lie where {crs.name} ({where}) is used only "
                "once x and y change places. Write x (east) first, or under its name: easting, northing."
            )
        latitude, longitude, *heights = change(x, y) if flat else change(x, y, z)
        # Whatever z is over, where the system has no heights.
        roughly = np.stack([latitude, longitude, *heights, *([z * up] if flat else [])], axis=1)
        return shifted(places, roughly)

    return changed, _name_of_system(crs, header, heights_as_xy)


def _unknown_system(crs: Any | None, header: str, file: Path, where: str) -> UnknownSystem:
    if crs is not None and crs.geodetic_crs is not None:
        fault = f"{where} names {crs.name}, which PROJ cannot compute. Give the coordinates in another system."
        return UnknownSystem(f"{file}: {fault}", header)
    return UnknownSystem(
        f"{file}: {where} must name the coordinate system (EPSG:32615, WGS84 UTM 15N, or a PROJ string), "
        f"and {header[:60]!r} names none.",
        header,
    )


def _name_of_system(crs: Any, header: str, heights_as_xy: bool) -> str:
    """The name of a system, and behind it what is assumed of its heights and datum."""
    name = crs.name if crs.name != "unknown" else header
    if crs.is_compound and not _has_grids(crs):
        name += WITHOUT_GEOID
    if heights := _UNKNOWN_HEIGHTS.match(header.strip(AROUND)):
        name += f"; heights as they are, for {heights[1]!r} is not known"
    unknown = crs.datum is not None and not _says_its_shift(crs) and crs.datum.name.lower().startswith("unknown")
    ellipsoid = crs.ellipsoid.name if unknown and crs.ellipsoid is not None else "WGS 84"
    if ellipsoid not in _GLOBAL:
        name += (
            f"; ellipsoid {ellipsoid} but no datum: taken as WGS 84, from which national datums differ by up "
            "to some hundred metres (an EPSG code, or +towgs84, names it)"
        )
    if len(crs.axis_info) == 2 and crs.is_projected and "foot" in (crs.axis_info[0].unit_name or ""):
        name += ALL_IN_FEET if heights_as_xy else HEIGHTS_IN_METERS
    return str(name)


class _Shifted:
    """Brings places of a system to WGS 84 by the one operation that maps in that system take too (`operation_at`): that
    of the first places asked for, and kept. Systems that say their shift themselves stay as PROJ has them."""

    def __init__(self, crs: Any, own_axes: bool, file: Path) -> None:
        self._crs, self._own_axes, self._file = crs, own_axes, file
        self._operation: DatumOperation | None = None
        self._as_they_are = True

    def __call__(self, places: Float[np.ndarray, "n 3"], roughly: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """`places` as the file has them, and `roughly` (within hundreds of metres) latitude, longitude and height."""
        known = np.isfinite(roughly).all(axis=1)
        if _says_its_shift(self._crs) or not known.any():
            return roughly
        if self._operation is None:
            self._choose(roughly[known])
            self._choose(self._changed(places[known], roughly[known]))  # now that the place is known to metres
        return self._changed(places, roughly)

    def _choose(self, geodetic: Float[np.ndarray, "n 3"]) -> None:
        if np.isfinite(geodetic).all():
            try:
                self._operation, self._as_they_are = _operation_about(self._crs, geodetic, self._own_axes)
            except NoOperation as error:
                raise CaptureError(f"{self._file}: {error}. Give the coordinates in another system.") from None

    def _changed(self, places: Float[np.ndarray, "n 3"], roughly: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        assert self._operation is not None
        if not self._as_they_are:
            return self._operation.to_geodetic(places)
        return self._operation.to_geodetic(np.column_stack([places[:, :2], roughly[:, 2]]))


def _operation_about(
    crs: Any, geodetic: Float[np.ndarray, "n 3"], own_axes: bool = False
) -> tuple[DatumOperation, bool]:
    """The operation for places (latitude, longitude, height), and whether it leaves heights as they are: for systems
    without heights, and for those whose geoid is not at hand."""
    latitude, longitude, _ = median_place(geodetic)
    found = operation_at(crs, latitude, longitude, own_axes)
    if crs.is_compound and (found.is_ballpark or found.made_for):
        return operation_at(_horizontal(crs), latitude, longitude, own_axes), True
    return found, len(crs.axis_info) == 2


def unit_without_heights(header: str) -> float:
    """Metres in the unit of x and y of a projected system that has no heights, and so says no unit of them; 1 for other
    systems."""
    import pyproj

    return _unit_without_heights(pyproj.CRS.from_user_input(pyproj_name(header)))


def _unit_without_heights(crs: Any) -> float:
    return float(crs.axis_info[0].unit_conversion_factor) if len(crs.axis_info) == 2 and crs.is_projected else 1.0


def height_unit(header: str | None) -> float:
    """Metres in the unit of the heights of a system that `to_geodetic` knows; 1 for no system, and for one without
    heights."""
    if header is None:
        return 1.0
    import pyproj

    axes = pyproj.CRS.from_user_input(pyproj_name(header)).axis_info
    return float(axes[2].unit_conversion_factor) if len(axes) > 2 else 1.0


def has_heights(header: str) -> bool:
    """Whether a system that `to_geodetic` knows has heights of its own."""
    import pyproj

    return len(pyproj.CRS.from_user_input(pyproj_name(header)).axis_info) > 2


def _to_latitude(crs: Any, target: str, own_axes: bool = False) -> Callable[..., tuple[Any, ...]]:
    """What brings x, y and, of three axes, z of a system to latitude, longitude and height of `target`.

    `own_axes`: x is the first of the system's axes, be that south; else east where the axes are north and east.

    `always_xy` of pyproj does not see that latitude is first where a system with heights holds one with TOWGS84, as
    Metashape writes it.
    """
    if own_axes:
        return _transformer(crs, target, False).transform
    unseen = crs.is_compound and any(part.is_bound for part in crs.sub_crs_list)
    north_first = [axis.direction.lower() for axis in crs.axis_info[:2]] == ["north", "east"]
    if unseen and north_first:
        change = _transformer(crs, target, False)
        return lambda x, y, *z: change.transform(y, x, *z)
    change = _transformer(crs, target, True)

    def changed(x: Any, y: Any, *z: Any) -> tuple[Any, ...]:
        longitude, latitude, *height = change.transform(x, y, *z)
        return latitude, longitude, *height

    return changed


@cache
def _transformer(crs: Any, target: Any, always_xy: bool) -> Any:
    """PROJ's way from a system to `target`, kept: it takes up to a second to be found."""
    import pyproj

    return pyproj.Transformer.from_crs(crs, target, always_xy=always_xy)


def _is_exchanged(crs: Any, change: Callable[..., tuple[Any, ...]], x: np.ndarray, y: np.ndarray) -> bool:
    """Whether places [n] lie where a projected system is used only once their coordinates are exchanged, and far from
    there as they are."""
    if not crs.is_projected or not len(x):
        return False
    area = _area_of(crs)
    if area is None or area.west > area.east:
        return False

    def is_near(place: tuple[float, ...]) -> bool:
        latitude, longitude = place[:2]
        north_south = area.south - BESIDE_DEG <= latitude <= area.north + BESIDE_DEG
        return north_south and area.west - BESIDE_DEG <= longitude <= area.east + BESIDE_DEG

    one, other, height = float(np.median(x)), float(np.median(y)), () if len(crs.axis_info) == 2 else (0.0,)
    return not is_near(change(one, other, *height)) and is_near(change(other, one, *height))


def _says_its_shift(crs: Any) -> bool:
    """Whether a system gives the shift of its datum itself (TOWGS84), with heights or without."""
    return bool(crs.is_bound or any(part.is_bound for part in crs.sub_crs_list))


def datum_error(header: str, geodetic: Float[np.ndarray, "n 3"]) -> tuple[float, str]:
    """By how many metres places (latitude, longitude, height) may be off that `to_geodetic` brought to WGS 84 from the
    datum of their system, and that in words; 0 and none for datums that are WGS 84 but for a metre or two, and for
    shifts that the header gives itself."""
    import pyproj

    crs = pyproj.CRS.from_user_input(pyproj_name(header))
    if _says_its_shift(crs) or crs.geodetic_crs is None or not len(geodetic):
        return 0.0, ""
    datum = crs.geodetic_crs.to_2d()
    if datum.is_geocentric:
        datum = pyproj.crs.GeographicCRS(datum=datum.datum)
    way, _ = _operation_about(crs, geodetic)
    if way.is_ballpark or math.isinf(way.accuracy_m):
        if is_near_wgs84(datum):
            return 0.0, ""
        if datum.name == "unknown":  # `to_geodetic` says so
            return UNKNOWN_DATUM_M, ""
        return UNKNOWN_DATUM_M, (
            f"taken as of WGS 84, for PROJ knows no shift from {datum.name} there (may be off by "
            f"{UNKNOWN_DATUM_M:.0f} m)"
        )
    if way.made_for and outside_area(header, geodetic):  # which says more
        return UNKNOWN_DATUM_M, ""
    if way.made_for:
        return ELSEWHERE_M, (
            f"converted from {datum.name} to WGS 84 by a shift that is made for "
            f"{shorten(way.made_for, 60, placeholder=' ...')} (may be off by {ELSEWHERE_M:.0f} m)"
        )
    place = np.array([median_place(geodetic)])
    x, y, _ = way.from_geodetic(place)[0]
    own = _transformer(_horizontal(crs), datum, True).transform(x, y) if not crs.is_geocentric else (math.inf,) * 2
    moved = np.abs(np.subtract(own, place[0, 1::-1])).max()
    if moved < _SAME_DEG or way.accuracy_m == 0:
        return 0.0, ""
    return way.accuracy_m, f"converted from {datum.name} to WGS 84, good to {way.accuracy_m:.2g} m"


def outside_area(header: str, geodetic: Float[np.ndarray, "n 3"]) -> list[str]:
    """What to say of places (latitude, longitude, height) that lie far from where their system is used."""
    import pyproj

    crs = pyproj.CRS.from_user_input(pyproj_name(header))
    area = _area_of(crs)
    if area is None or not len(geodetic):
        return []
    away = meters_outside(area, *median_place(geodetic)[:2])
    if away < OUTSIDE_M:
        return []
    where = shorten(area.name.rstrip("."), 60, placeholder=" ...")
    return [
        f"its places lie {away / 1000:,.0f} km outside of the area that {crs.name} is made for ({where}), and are "
        "used all the same. Is it the right system, and have x (east) and y (north) the right signs?"
    ]


def meters_outside_area(header: str, x: float, y: float) -> float:
    """How far a place lies from the area that a system which `to_geodetic` knows is made for, in metres; 0 inside,
    infinite for no place on Earth, NaN where the system names no area. x (east) and y (north) in the system's units."""
    import pyproj

    crs = pyproj.CRS.from_user_input(pyproj_name(header))
    area = _area_of(crs)
    if area is None:
        return math.nan
    latitude, longitude, *_ = map(float, _to_latitude(_horizontal(crs), "EPSG:4326")(x, y))
    return meters_outside(area, latitude, longitude) if math.isfinite(latitude + longitude) else math.inf


def _area_of(crs: Any) -> Any | None:
    """The area that a system is made for, or of several parts the first that names one."""
    return next((part.area_of_use for part in (crs, *crs.sub_crs_list) if part.area_of_use is not None), None)


def _horizontal(crs: Any) -> Any:
    return crs.sub_crs_list[0] if crs.is_compound else crs


def look_like_degrees(places: np.ndarray) -> bool:
    """Whether x and y [n, 2] are latitudes and longitudes of one place: as metres they would be one and the same."""
    if len(places) < 3 or (np.abs(places) > [180, 180]).any():
        return False
    spread = np.ptp(places, axis=0)
    return bool((np.abs(places[0]) > 1).any() and 0 < spread.max() < _ONE_PLACE)


@cache
def _has_grids(crs: Any) -> bool:
    """Whether the best way from a system with heights above a geoid to those above the ellipsoid is at hand; of some
    geoids PROJ knows no grid at all. PROJ looks seconds for it, and a table asks several times."""
    import pyproj

    with warnings.catch_warnings():  # said in words instead
        warnings.simplefilter("ignore", UserWarning)
        group = pyproj.transformer.TransformerGroup(crs, "EPSG:4979", always_xy=True)
    return bool(group.best_available) and not all(map(is_ballpark, group.transformers))


def is_in_degrees(header: str) -> bool:
    """Whether a system that `to_geodetic` knows counts across in degrees."""
    import pyproj

    return bool(pyproj.CRS.from_user_input(pyproj_name(header)).is_geographic)


def is_geocentric(header: str) -> bool:
    """Whether a system that `to_geodetic` knows counts from the middle of the Earth: then no z is no place."""
    import pyproj

    return bool(pyproj.CRS.from_user_input(pyproj_name(header)).is_geocentric)


def geocentric_to_geodetic(header: str, file: Path) -> ToGeodetic:
    """What brings Earth-centred metres of the datum of a system to latitude, longitude and height of WGS 84: by the
    shift that the system gives itself (TOWGS84), or as PROJ knows its datum."""
    if re.search(r"EPSG:4326|GEOG(CS|CRS|RAPHICCRS)\[\s*\"WGS[ _]?(19)?84", header, re.I):
        return geodetic_from_ecef
    try:
        import pyproj
        from pyproj.crs.crs import GeocentricCRS
    except ImportError:
        raise CaptureError(f"{file}: needs pyproj: pip install 'vdgs[geo]'.") from None
    try:
        crs = pyproj.CRS.from_user_input(pyproj_name(header))
        if (shift := _own_shift(crs)) is not None:
            return lambda places: geodetic_from_ecef(np.stack(shift.transform(*places.T), axis=1))
        datum = (crs.geodetic_crs or crs).datum
        earth = GeocentricCRS(datum=datum)
        change = _transformer(earth, "EPSG:4979", True)
        system = earth if crs.is_geocentric or crs.is_bound else _horizontal(crs)
        to_system = _transformer(earth, system, True)
    except (pyproj.exceptions.ProjError, TypeError, AttributeError):
        raise UnknownSystem(f"{file}: the coordinate system {header[:60]!r} is not understood.", header) from None
    shifted = _Shifted(system, False, file)

    def changed(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        longitude, latitude, height = change.transform(*places.T)
        roughly = np.stack([latitude, longitude, height], axis=1)
        return np.column_stack([shifted(np.stack(to_system.transform(*places.T), axis=1), roughly)[:, :2], height])

    return changed


#: The parameters of TOWGS84, as PROJ names them; the first three may stand alone.
_HELMERT = ("x", "y", "z", "rx", "ry", "rz", "s")


def false_origin(header: str) -> tuple[float, float]:
    """What a projected system adds to its eastings and northings, in its unit; 0, 0 for other systems."""
    import pyproj

    crs = pyproj.CRS.from_user_input(pyproj_name(header))
    crs = _horizontal(crs)
    crs = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    if not crs.is_projected or crs.coordinate_operation is None:
        return 0.0, 0.0
    values = {each.name.lower(): float(each.value) for each in crs.coordinate_operation.params}
    east, north = (
        next((value for name, value in values.items() if word in name), 0.0) for word in ("easting", "northing")
    )
    return east, north


def _own_shift(crs: Any) -> Any | None:
    """The transformer of Earth-centred metres by the parameters of TOWGS84 (a Helmert transformation, EPSG's position
    vector convention, rotations in seconds of arc, scale in ppm); None where the system gives none."""
    import pyproj

    bound = next((part for part in (crs, *crs.sub_crs_list) if part.is_bound), None)
    values = list(bound.coordinate_operation.towgs84) if bound is not None and bound.coordinate_operation else []
    if len(values) not in (3, 7):
        return None
    words = " ".join(f"+{name}={value}" for name, value in zip(_HELMERT, values, strict=False))
    return pyproj.Transformer.from_pipeline(f"+proj=helmert {words} +convention=position_vector")
