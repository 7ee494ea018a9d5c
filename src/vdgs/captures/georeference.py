"""What a capture says about its place on Earth: georef.json and GPS tables."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.captures.flight_extent import LOCAL_METERS, why_no_flight
from vdgs.captures.gps_altitudes import with_altitudes, without_zero_altitudes
from vdgs.captures.gps_tables import GpsRow, check_geodetic, read_gps_table
from vdgs.captures.name_resolution import NameLookup, ambiguity_message
from vdgs.captures.odd_positions import are_far_off, are_nowhere
from vdgs.captures.plane_fit import LEAST_M
from vdgs.errors import CaptureError
from vdgs.system.units import first_names

#: What georef.json calls a world that has its place on Earth, and one that only has metres and up.
ENU_FRAME, LOCAL_FRAME = "ENU, metres, x east y north z up", "local, metres, z up; no place on Earth"
ORIGIN_KEYS = ("origin_lat_deg", "origin_lon_deg", "origin_alt_m")
_ENDING = re.compile(r"\.[A-Za-z]{3,4}$")
_Find = Callable[[str], tuple[tuple[int, int], list[int]]]


@dataclass(frozen=True)
class Georef:
    """What georef.json says of a world in metres, z up."""

    origin: tuple[float, float, float] | None
    """Latitude and longitude in degrees, altitude in metres; None where it has no place on Earth."""
    accuracy: str
    """In words; empty where it says none."""
    method: str = ""
    """How the place was found, in words; empty where it says none."""


def read_georef(file: Path) -> Georef:
    """The origin of a world that already is ENU metres, or only metres with z up, and its accuracy.

    Raises `CaptureError` if the file is missing, is not JSON, or does not promise an ENU frame in metres.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror}).") from error
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{file}: is not JSON ({error}). Mend it, or remove it to do without.") from None
    accuracy, method = ("", "") if not isinstance(content, dict) else (_accuracy(content), _words(content, "method"))
    if isinstance(content, dict) and content.get("frame") == LOCAL_FRAME:
        return Georef(None, accuracy, method)
    if not isinstance(content, dict) or "ENU" not in str(content.get("frame", "ENU")):
        raise CaptureError(
            f"{file}: describes no ENU frame (x east, y north, z up, metres). Only ENU worlds are "
            "understood; give --up instead and remove the file."
        )
    try:
        origin = tuple(float(content[key]) for key in ORIGIN_KEYS)
    except (KeyError, TypeError, ValueError):
        raise CaptureError(f"{file}: must give numbers for {', '.join(ORIGIN_KEYS)}.") from None
    check_geodetic(origin, file)
    return Georef(origin, accuracy, method)  # type: ignore[arg-type]


def _words(content: Mapping[str, object], key: str) -> str:
    value = content.get(key)
    return value if isinstance(value, str) else ""


def _accuracy(content: Mapping[str, object]) -> str:
    """The accuracy that a georef.json states; the residuals where the file gives residuals alone."""
    if stated := _words(content, "accuracy"):
        return stated
    for key, of in (("gcp", "control points"), ("gps", "positions")):
        values = content.get(f"{key}_residual_rms_m_xyz")
        if isinstance(values, list) and len(values) == 3 and all(isinstance(each, (int, float)) for each in values):
            east, north, up = values
            return f"residuals of {of}: RMS {east:.2g} m east, {north:.2g} m north, {up:.2g} m up"
    return ""


def _by_number(names: Sequence[str]) -> _Find:
    """What finds photographs by the number that DJI gives them: the last group of four digits of their names."""
    found: dict[int, list[int]] = {}
    for index, name in enumerate(names):
        digits = re.findall(r"(?<!\d)\d{4}(?!\d)", _ENDING.sub("", name.rpartition("/")[2]))
        if digits:
            found.setdefault(int(digits[-1]), []).append(index)
    return lambda number: ((0, 0), found.get(int(number), []) if number.isdecimal() else [])


@dataclass(frozen=True, eq=False)
class GpsPositions:
    """The positions that a table has of the images of a capture."""

    images: np.ndarray
    """Indices [m] of the images."""
    geodetic: np.ndarray
    """Latitude, longitude (degrees) and altitude (metres) [m, 3]."""
    has_altitudes: bool
    """Whether altitudes are known (0 where not; where all are exactly 0, too)."""
    notes: tuple[str, ...]
    """What the table leaves in doubt."""
    datum_error_m: float
    """How far all places may be off by the datum of the table's system."""
    deviations: np.ndarray
    """Standard deviations east, north and up that the table states [m, 3], metres; NaN where it states none."""


def match_gps(names: Sequence[str], file: Path) -> GpsPositions:
    """The positions of those images that a table has one of, without those at 0, 0 and those far from all others.

    Raises `CaptureError` as `read_gps_table` and `match_rows` do.
    """
    table = read_gps_table(file)
    found = match_rows(names, table.rows, file, table.numbered)
    notes = [*table.notes, *unmatched_notes(table.rows, found, file)]
    positions = np.array([row.position for row in found.values()]).reshape(-1, 3)

    def name_unused(which: np.ndarray, why: str) -> None:
        if which.any():
            unused = first_names([names[image] for image, named in zip(found, which, strict=True) if named])
            notes.append(f"{file.name}: {unused}: the position {why}; not used.")

    nowhere = are_nowhere(positions)
    name_unused(nowhere, "is 0, 0 (no satellites yet)")
    known = ~nowhere
    if known.any():
        far = known & are_far_off(positions, known)
        name_unused(far, "is far from all others")
        known &= ~far
    positions = without_zero_altitudes(positions, known)
    kept, has_altitudes = with_altitudes(positions[:, 2], known)
    name_unused(known & ~kept, "has no altitude")
    if not has_altitudes and (others := int((known & np.isfinite(positions[:, 2])).sum())):
        notes.append(f"{file.name}: most positions have no altitude; those of {others} are not used.")
    positions = np.where([True, True, has_altitudes], positions, 0.0)
    images = np.array(list(found), int)[kept]
    stated = [(math.nan,) * 3 if row.gps_std is None else (row.gps_std[0], *row.gps_std) for row in found.values()]
    deviations = np.maximum(np.array(stated).reshape(-1, 3)[kept], LEAST_M)
    return GpsPositions(images, positions[kept], has_altitudes, tuple(notes), table.datum_error_m, deviations)


def match_rows(names: Sequence[str], rows: Sequence[GpsRow], file: Path, numbered: bool = False) -> dict[int, GpsRow]:
    """The rows of those images that have one, by their indices, sorted.

    Names match by their whole path, else by the end of it, else without extension; only where the table's folders are
    not those of the images, by what lies in them. Raises `CaptureError` where a name may be of several images, where
    several rows place one image differently, if no name matches: then it is another flight's table; and where the
    positions cannot be of one flight: then they are no degrees.
    """
    lookup = NameLookup((name, index) for index, name in enumerate(names))
    if numbered:
        found = _best_rows(names, rows, _by_number(names), file, numbered)
    else:
        found = _best_rows(names, rows, lookup.find, file) or _best_rows(names, rows, lookup.find_elsewhere, file)
    if not found:
        raise CaptureError(
            f"{file}: none of its {len(rows)} rows names one of the capture's {len(names)} images "
            f"(for example {names[0]!r}). Give the table of this flight, or leave --gps out."
        )
    if why := why_no_flight(np.array([row.position for row in found.values()]), len(names)):
        latitude, longitude, _ = next(iter(found.values())).position
        raise CaptureError(
            f"{file}: its positions, such as {latitude:.10g}, {longitude:.10g}, are no latitudes and longitudes of one "
            f"flight: {why}. Are they metres? {LOCAL_METERS}; metres of a projected system need its code as a first "
            "line of its own, such as EPSG:32633."
        )
    return dict(sorted(found.items()))


def unmatched_notes(rows: Sequence[GpsRow], found: Mapping[int, GpsRow], file: Path) -> list[str]:
    """What to say of rows that are of no photograph."""
    used = {row.name for row in found.values()}  # rows that say the same of a photograph twice are no others
    spare = list(dict.fromkeys(row.name for row in rows if row.name not in used))
    if not spare:
        return []
    return [f"{file.name}: {len(spare)} rows are of photographs that are not there; left out ({first_names(spare)})."]


def _best_rows(
    names: Sequence[str], rows: Sequence[GpsRow], find: _Find, file: Path, numbered: bool = False
) -> dict[int, GpsRow]:
    """For each image that rows name, by its index, the row that names it best."""
    named: dict[int, list[tuple[tuple[int, int], list[int], GpsRow]]] = {}
    for row in rows:
        rank, which = find(row.name)
        for index in which:
            named.setdefault(index, []).append((rank, which, row))
    found = {}
    for index, claims in named.items():
        best = min(rank for rank, _, _ in claims)
        (which, row), *others = [(which, row) for rank, which, row in claims if rank == best]
        if len(which) > 1:
            one, other = names[which[0]], names[which[1]]
            said = (
                f"number {row.name} may be {one} or {other}: the drone writes such a file for one flight. Place the "
                "flights one by one, or give one table name,lat,lon,alt of all."
                if numbered
                else ambiguity_message(row.name, one, other)
            )
            raise CaptureError(f"{file}: line {row.line}: {said}")
        differs = next((each for _, each in others if not _same_place(each, row)), None)
        if differs is not None:
            raise CaptureError(
                f"{file}: lines {row.line} and {differs.line} ({row.name!r}, {differs.name!r}) give {names[index]} "
                "different positions. Keep its own row only; photographs of one name need their folders, in the table "
                "and on disk."
            )
        found[index] = row
    return found


def _same_place(one: GpsRow, other: GpsRow) -> bool:
    return np.array_equal(one.position, other.position, equal_nan=True)
