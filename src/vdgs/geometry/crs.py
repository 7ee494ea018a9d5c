"""Coordinate systems of the EPSG catalogue, by pyproj: which one, by which operation, in which units."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from textwrap import shorten
from typing import Any

import numpy as np
from jaxtyping import Float

from vdgs.errors import VdgsError

#: Where the altitudes of photographs come from is not known here; what they are taken for is.
ELLIPSOIDAL_REFERENCE = "ellipsoidal (WGS 84), if the altitudes of the georeference are"
#: Half the side of the area, in degrees, for which the best operation between two systems is chosen.
_AREA_DEG = 0.05


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
    #: The factor from metres to the heights of the system: systems without heights get them in their own unit.
    _height_factor: float
    _transformer: Any

    def from_geodetic(self, geodetic: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """(latitude deg, longitude deg, ellipsoidal height m) to (easting, northing, height); inf out of reach."""
        latitude, longitude, height = geodetic.T
        x, y, z = self._transformer.transform(longitude, latitude, height)
        return np.stack([x, y, np.asarray(z) * self._height_factor], axis=1)

    def to_geodetic(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The inverse of `from_geodetic`."""
        # Between datums of two dimensions PROJ inverts to a millimetre only; once more, what is missing is a nanometre.
        missed = points - self.from_geodetic(self._inverted(points))
        return self._inverted(points + missed)

    def _inverted(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        x, y, z = points.T
        longitude, latitude, height = self._transformer.transform(x, y, z / self._height_factor, direction="INVERSE")
        return np.stack([latitude, longitude, height], axis=1)


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
    transformer, notes = _operation(crs, code, origin)
    own_heights = len(axes) == 3
    unit = "m" if meters == 1.0 else axes[0].unit_name
    heights = axes[2].name if own_heights else ELLIPSOIDAL_REFERENCE
    heights = "from the middle of the Earth" if crs.is_geocentric else heights
    return CrsTransform(
        code=code, name=crs.name, unit=unit, meters_per_unit=meters, wkt=crs.to_wkt(),
        height_reference=heights if unit == "m" else f"{heights}; in {unit}", notes=notes,
        _height_factor=1.0 if own_heights else 1 / meters, _transformer=transformer,
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


def _operation(crs: Any, code: str, origin: tuple[float, float, float]) -> tuple[Any, tuple[str, ...]]:
    """One operation for the whole scene (asked point by point, PROJ may change it in between), and notes about it."""
    from pyproj.aoi import AreaOfInterest
    from pyproj.transformer import TransformerGroup

    latitude, longitude, _ = origin
    area: Any = AreaOfInterest(
        longitude - _AREA_DEG, max(latitude - _AREA_DEG, -90), longitude + _AREA_DEG, min(latitude + _AREA_DEG, 90)
    )
    with warnings.catch_warnings():  # said below, in words
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup("EPSG:4979", crs, always_xy=True, area_of_interest=area)
    needed = [grid for operation in group.unavailable_operations for grid in operation.grids]
    grids = sorted({grid.short_name for grid in needed if not grid.available})
    missing = f" It needs {' or '.join(grids[:3])}: `projsync --file NAME` fetches one." if grids else ""
    if not group.transformers:
        raise VdgsError(f"--crs {code}: PROJ knows no way from WGS 84 to {crs.name}.{missing} Give another system.")
    found, elsewhere = group.transformers[0], False
    if _is_ballpark(found) and (shift := _datum_shift(crs)) is not None:
        found, elsewhere = shift, True
    if len(crs.axis_info) == 3 and not crs.is_geocentric and _is_ballpark(found):
        vertical = crs.sub_crs_list[-1].name if crs.is_compound else crs.axis_info[2].name
        raise VdgsError(
            f"--crs {code}: its heights ({vertical}) cannot be had from heights above the ellipsoid here.{missing} Or "
            f"give the system without heights, {code.partition('+')[0]}."
        )
    notes = []
    if elsewhere:
        area = shorten(found.area_of_use.name if found.area_of_use else "elsewhere", 60, placeholder=" ...")
        notes.append(
            f"{crs.name} is reached by a datum shift that is made for {area}; here coordinates may be off by tens of "
            f"metres.{missing}"
        )
    elif _is_ballpark(found):
        notes.append(
            f"{crs.name} is reached without a datum shift: coordinates may be off by hundreds of metres.{missing}"
        )
    elif not group.best_available:
        notes.append(f"{crs.name} is reached to about {found.accuracy:g} m, its best operation is missing.{missing}")
    use = crs.area_of_use
    if use is not None and not _inside(latitude, longitude, use):
        notes.append(f"{crs.name} is made for {use.name}; this place lies outside, and lengths are distorted.")
    return found, tuple(notes)


def _is_ballpark(operation: Any) -> bool:
    """Whether PROJ takes latitude and longitude for those of the other datum."""
    return "ballpark" in operation.description.lower()


def _datum_shift(crs: Any) -> Any | None:
    """The best way from WGS 84 to a system wherever it is made for, with a datum shift; None where PROJ has none."""
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        ways = TransformerGroup("EPSG:4979", crs, always_xy=True).transformers
    return next((way for way in ways if not _is_ballpark(way)), None)


def _inside(latitude: float, longitude: float, use: Any) -> bool:
    across = (longitude - use.west) % 360 <= (use.east - use.west) % 360 or abs(use.east - use.west) >= 360
    return bool(across and use.south <= latitude <= use.north)
