"""Positions that EXIF says to be of another datum (GPSMapDatum) than WGS 84."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from vdgs.captures.coordinate_systems import UNKNOWN_DATUM_M
from vdgs.geometry.datum_operation import DatumOperation, NoOperation, operation_at
from vdgs.sfm.exif_gps import Place, plain_text

#: Datums that agree with WGS 84 to a metre or two.
_GLOBAL = re.compile(
    r"WGS[-_ ]*(19)?84|ITRF|ETRS|JGD|CGCS|GDA|NAD[-_ ]*(19)?83|SIRGAS|PZ[-_ ]*90|GRS[-_ ]*(19)?80|KGD|NZGD[-_ ]*20"
    r"|RGF[-_ ]*93|SWEREF[-_ ]*99|ETRF|EUREF|REGCAN[-_ ]*95|HARTEBEESTHOEK[-_ ]*94|POSGAR|MAGNA|TWD[-_ ]*97|CSRS|^GPS$"
    r"|IGS[-_ ]?\d|\bWG?S?84\b|WORLD GEODETIC SYSTEM([-_ ]*OF)?[-_ ]*(19)?84|^(EPSG:*)?(4326|4979)$",
    re.I,
)
_NOTHING = re.compile(r"unknown|undefined|none|n/?a|null|0*|-*", re.I)
#: China's maps are shifted on purpose, by up to so many metres.
_SHIFTED = ((re.compile(r"GCJ", re.I), 700.0), (re.compile(r"BD[-_ ]?09|BAIDU", re.I), 1300.0))
#: Words of cameras in place of PROJ's names.
_NAMES = (
    (r"S[K]?[-_ ]*(19)?42\b|KRASS?OWSK[IY]|PULKOVO.*", "Pulkovo 1942"), (r"POTSDAM", "DHDN"), (r"TOKYO.*", "Tokyo"),
    (r"(N(ORTH )?AMERICAN|NAD)[-_ ]*(DATUM)?[-_ ]*(19)?27.*", "NAD27"),
)  # fmt: skip


def to_wgs84(place: Place, gps: Mapping[int, Any]) -> tuple[Place, str, float]:
    """A place in EXIF as one of WGS 84; what people should know of its datum, and by how many metres it may be off.

    PROJ converts with what it brings along; nothing is downloaded. A place of a datum that it does not know stays.
    """
    datum = plain_text(gps.get(0x12))
    if _NOTHING.fullmatch(datum) or _GLOBAL.search(datum):
        return place, "", 0.0
    shifted = next((meters for words, meters in _SHIFTED if words.search(datum)), None)
    named = next((name for words, name in _NAMES if re.fullmatch(words, datum, re.I)), datum)
    try:
        found = None if shifted else _way(named, round(place[0]), round(place[1]))
    except ImportError:
        return place, f"{_of(datum, UNKNOWN_DATUM_M)}; pip install 'vdgs[geo]' converts it", UNKNOWN_DATUM_M
    if found is None:
        error_m = shifted or UNKNOWN_DATUM_M
        remedy = "a table of positions, --gps, whose first line names the system, mends it"
        return place, f"{_of(datum, error_m)}; {remedy}", error_m
    change, error_m = found
    latitude, longitude, _ = change.to_geodetic(np.array([[place[1], place[0], 0.0]]))[0].tolist()
    if not math.isfinite(latitude + longitude):  # beside a grid
        return place, _of(datum, UNKNOWN_DATUM_M), UNKNOWN_DATUM_M
    return (latitude, longitude), f"positions are of the datum {datum}: converted (good to {error_m:.2g} m)", error_m


def _of(datum: str, error_m: float) -> str:
    return f"positions are of the datum {datum}: taken as of WGS 84 (may be off by {error_m:.0f} m)"


@lru_cache(maxsize=64)
def _way(datum: str, latitude: int, longitude: int) -> tuple[DatumOperation, float] | None:
    """The best way from a datum to WGS 84 near a place, and how good it is in metres; None where PROJ knows none."""
    import pyproj

    try:
        crs = pyproj.CRS.from_user_input(datum)
        if not crs.is_geographic:
            return None
        found = operation_at(crs, latitude, longitude)
    except (pyproj.exceptions.ProjError, NoOperation):
        return None
    usable = not (found.is_ballpark or found.made_for) and 0 < found.accuracy_m < math.inf
    return (found, found.accuracy_m) if usable else None
