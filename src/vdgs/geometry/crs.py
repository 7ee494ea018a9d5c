"""Coordinate systems of the EPSG catalogue, by pyproj: which one, by which operation, in which units."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import shorten
from typing import Any

import numpy as np
from jaxtyping import Float

from vdgs.errors import VdgsError
from vdgs.geometry.datum_operation import DatumOperation, NoOperation, is_inside, is_near_wgs84, operation_at

#: Where the altitudes of photographs come from is not known here; what they are taken for is.
ELLIPSOIDAL_REFERENCE = "ellipsoidal (WGS 84), if the altitudes of the georeference are"


@dataclass(frozen=True, eq=False, kw_only=True)
class CrsTransform:
    """One system of the catalogue and the one operation that leads to it from WGS 84."""

    code: str
    name: str
    unit: str
    #: Metres per unit.
    meters_per_unit: float
    wkt: str
    height_reference: str
    notes: tuple[str, ...]
    #: Whether coordinates count from the middle of the Earth.
    is_geocentric: bool
    #: The factor from metres to the heights of the system: systems without heights get them in their own unit.
    _height_factor: float
    _operation: DatumOperation

    def from_geodetic(self, geodetic: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """(latitude deg, longitude deg, ellipsoidal height m) to (easting, northing, height); inf out of reach."""
        return self._operation.from_geodetic(geodetic) * [1, 1, self._height_factor]

    def to_geodetic(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The inverse of `from_geodetic`."""
        return self._operation.to_geodetic(points / [1, 1, self._height_factor])


def utm_epsg(latitude_deg: float, longitude_deg: float) -> str:
    """The code of the UTM zone (six degrees wide, WGS 84) of a place; beyond 84° north and 80° south, of UPS."""
    if latitude_deg >= 84 or latitude_deg <= -80:
        return "EPSG:32661" if latitude_deg > 0 else "EPSG:32761"
    zone = int((longitude_deg + 180) % 360 // 6) + 1
    return f"EPSG:{(32600 if latitude_deg >= 0 else 32700) + zone}"


def open_crs(code: str, origin: tuple[float, float, float]) -> CrsTransform:
    """The system `EPSG:n` (or `EPSG:n+m` with heights) for a scene about `origin` (lat deg, lon deg, height m).

    Raises VdgsError for a code that is unknown, in degrees, of axes that are not east and north, of mixed units or with
    heights that cannot be had, and where pyproj is not installed.
    """
    try:
        import pyproj
    except ImportError:
        raise VdgsError(f"--crs {code}: needs pyproj: pip install 'vdgs[geo]', or --crs enu or local.") from None
    code = code.upper()
    try:
        crs = pyproj.CRS.from_user_input(code)
    except pyproj.exceptions.CRSError:
        raise VdgsError(f"--crs {code}: is not in the EPSG catalogue (epsg.org). A UTM zone is EPSG:326zz.") from None
    if not (crs.is_geocentric or _horizontal(crs).is_projected):
        raise VdgsError(
            f"--crs {code}: {crs.name} is not in metres across (degrees, or heights alone). Give a projected system, "
            f"such as {utm_epsg(*origin[:2])}, or leave --crs out."
        )
    _check_axes(crs, code, origin)
    axes = crs.axis_info
    meters = float(axes[0].unit_conversion_factor)
    if any(abs(axis.unit_conversion_factor - meters) > 1e-12 for axis in axes):
        raise VdgsError(f"--crs {code}: {crs.name} counts across and up in different units. Give one with one unit.")
    operation, notes = _operation(crs, code, origin)
    own_heights = len(axes) == 3
    unit = "m" if meters == 1.0 else axes[0].unit_name
    heights = axes[2].name if own_heights else ELLIPSOIDAL_REFERENCE
    heights = "from the middle of the Earth" if crs.is_geocentric else heights
    return CrsTransform(
        code=code, name=crs.name, unit=unit, meters_per_unit=meters, wkt=crs.to_wkt(),
        height_reference=heights if unit == "m" else f"{heights}; in {unit}", notes=notes,
        is_geocentric=crs.is_geocentric,
        _height_factor=1.0 if own_heights else 1 / meters, _operation=operation,
    )  # fmt: skip


def _horizontal(crs: Any) -> Any:
    return crs.sub_crs_list[0] if crs.is_compound else crs


def _check_axes(crs: Any, code: str, origin: tuple[float, float, float]) -> None:
    """Raise VdgsError for coordinates that grow to the west: maps and scenes would be turned about, or as in a mirror.

    Both axes of a polar system lead south, or both north: they lie to each other as east and north do.
    """
    towards = [axis.direction for axis in _horizontal(crs).axis_info[:2]]
    if "west" not in towards:
        return
    twin = _of_name(f"{_horizontal(crs).name} East North")
    other = f"its twin to the east and north, {twin}" if twin else f"another, such as {utm_epsg(*origin[:2])}"
    raise VdgsError(
        f"--crs {code}: {crs.name} counts to the {towards[0]} and {towards[1]}; maps and scenes need east and north. "
        f"Give {other}, or leave --crs out."
    )


def _of_name(name: str) -> str | None:
    """The code of the projected system of this name, if the catalogue has one."""
    from pyproj.database import query_crs_info
    from pyproj.enums import PJType

    known = query_crs_info(auth_name="EPSG", pj_types=[PJType.PROJECTED_CRS])
    return next((f"EPSG:{each.code}" for each in known if each.name == name), None)


def _operation(crs: Any, code: str, origin: tuple[float, float, float]) -> tuple[DatumOperation, tuple[str, ...]]:
    """The operation for the whole scene, and notes about it."""
    latitude, longitude, _ = origin
    try:
        found = operation_at(crs, latitude, longitude)
    except NoOperation as error:
        raise VdgsError(
            f"--crs {code}: {error}. Give another system, such as {utm_epsg(latitude, longitude)}."
        ) from None
    grids = " or ".join(found.missing_grids[:3])
    missing = f" It needs {grids}: `projsync --file NAME` fetches one." if grids else ""
    if len(crs.axis_info) == 3 and not crs.is_geocentric and found.is_ballpark:
        vertical = crs.sub_crs_list[-1].name if crs.is_compound else crs.axis_info[2].name
        flat = _horizontal(crs).to_epsg() or utm_epsg(latitude, longitude)[5:]
        raise VdgsError(
            f"--crs {code}: its heights ({vertical}) cannot be had from heights above the ellipsoid here.{missing} Or "
            f"give the system without heights, EPSG:{flat}."
        )
    notes = []
    if found.made_for:
        area = shorten(found.made_for, 60, placeholder=" ...")
        notes.append(
            f"{crs.name} is reached by a datum shift that is made for {area}; here coordinates may be off by tens of "
            f"metres.{missing}"
        )
    elif found.is_ballpark:
        off = "a metre or two" if is_near_wgs84(crs) else "hundreds of metres"
        notes.append(f"{crs.name} is reached without a datum shift: coordinates may be off by {off}.{missing}")
    elif missing:
        notes.append(f"{crs.name} is reached to about {found.accuracy_m:g} m, its best operation is missing.{missing}")
    use = crs.area_of_use
    if use is not None and not is_inside(use, latitude, longitude):
        notes.append(f"{crs.name} is made for {use.name}; this place lies outside, and lengths are distorted.")
    return found, tuple(notes)
