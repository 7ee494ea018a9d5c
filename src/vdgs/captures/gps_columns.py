"""What the columns of a table of positions are, by their headings, by the coordinate system, or by their order."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from vdgs.captures.column_headings import Heading, read_heading
from vdgs.captures.coordinate_systems import is_in_degrees, look_like_degrees, to_geodetic
from vdgs.captures.decimal_signs import doubt_of
from vdgs.captures.flight_extent import LOCAL_METERS, NO_LAND_DEG, why_no_flight
from vdgs.captures.pose_texts import are_quaternions, has_local_places
from vdgs.captures.system_names import is_local_system
from vdgs.captures.table_columns import (
    Row,
    has_time,
    known_columns,
    meters_of,
    number_of,
    parted_angles,
    told_meters,
    west_or_east,
    with_names,
    with_sides,
)
from vdgs.errors import CaptureError

#: What errors say of a track, which has a position for each moment.
BY_TIME = (
    "by time and not by photograph. Let `exiftool -geotag TRACK PHOTOGRAPHS`, or the receiver's own program, write the "
    "positions into the photographs."
)
#: Columns of accuracies.
DEVIATIONS = ("across", "upwards", "eastwards", "northwards")
#: Coordinates of a projected system are so large, in metres, and one of them larger than any photograph has pixels; a
#: flight is no wider (choice).
_FLIGHT_FROM, _PROJECTED_FROM, _FLIGHT_WIDE = 1_000.0, 20_000.0, 100_000.0


class NoSystem(CaptureError):
    """A table of x and y whose coordinate system nothing names, with the photographs that it names, and whether x and y
    are positions for sure: sizes, marks and scores of photographs look alike."""

    def __init__(self, message: str, names: Sequence[str], *, are_positions: bool) -> None:
        super().__init__(message)
        self.names, self.are_positions = tuple(names), are_positions


class HoldsPoses(CaptureError):
    """A table of the poses of a program, in metres of its own."""


class Columns(NamedTuple):
    """The columns of a table, and what their values count in."""

    where: dict[str, int]
    """Which word of a row is what."""
    system: str | None
    """The coordinate system that the table names."""
    altitude_unit: float | None = None
    """Metres in one of its altitudes; None where their heading does not say, which are in the system's unit."""
    system_altitude_unit: float = 1.0
    """Metres in the unit of the system's heights."""
    note: str = ""
    """How columns are read that do not say it themselves."""
    heights: tuple[str, ...] = ()
    """Names of the columns of altitudes: the one that is read, and those that are not."""
    deviation_units: Mapping[str, float] = MappingProxyType({})
    """Metres in one of each of its accuracies, NaN for angles."""
    across_units: tuple[float | None, float | None] = (None, None)
    """Metres (of angles degrees) in one of x and of y; None where their names say no unit: then it is the system's."""
    unit_note: str = ""
    """What is said of the unit of x and y, where headings and system may both be meant."""
    angles: Mapping[str, Heading] = MappingProxyType({})
    """The headings of latitudes and longitudes."""
    o_side: str = ""
    """What O stands for, E or W, where the headings tell."""


def read_columns(rows: list[Row], system: str | None, file: Path) -> tuple[Columns, list[Row]]:
    """The columns and the rows below their names. Raises CaptureError."""
    head, *body = rows
    below = [row.words for row in body]
    known = with_sides(with_names(head.words, known_columns(head.words), below), below)
    if {"lat", "lon"} <= set(known):
        _refuse_parted_angles(head.words, file)
        if "name" not in known:
            raise _lacks_names(head.words, file)
        return _with_angles(_described(head.words, known), rows, system, file), body
    if {"name", "x", "y"} <= set(known):
        return _with_plane(_described(head.words, known), rows, system, file), body
    if not _has_numbers(head):
        raise _lacks_headings(rows, known, system, file)
    return _by_order(rows, system, file), rows


def _refuse_parted_angles(words: Sequence[str], file: Path) -> None:
    if parts := parted_angles(words):
        raise CaptureError(
            f"{file}: has minutes and seconds in columns of their own ({', '.join(map(repr, parts))}). Write each "
            "angle into one column: name,lat,lon,alt with degrees such as -33.51234, or words such as 33 30 44.4 S."
        )


def _lacks_names(words: Sequence[str], file: Path) -> CaptureError:
    found = ", ".join(word for word in words if word)
    remedy = f"It is {BY_TIME}" if has_time(words) else "Call the column that has them `name`, or add it."
    return CaptureError(f"{file}: has positions but no column of photographs' names (found: {found}). {remedy}")


def _lacks_headings(rows: Sequence[Row], known: Mapping[str, int], system: str | None, file: Path) -> CaptureError:
    found = ", ".join(sorted(word for word in rows[0].words if word)) or "nothing"
    is_local = is_local_system(" ".join(rows[0].words)) or has_local_places(rows[0].words)
    if system is None and is_local:
        raise CaptureError(f"{file}: holds positions of a local system (found: {found}). {LOCAL_METERS}.")
    marks = "" if system is None else " A list of control points is given as --gcp."
    if system is None and not known and len(rows) > 1 and _has_numbers(rows[1]):
        marks = " If it is to name a coordinate system, write its code, such as EPSG:32633."
    return CaptureError(f"{file}: needs a first line that names the columns name,lat,lon,alt (found: {found}).{marks}")


def _described(words: Sequence[str], known: dict[str, int]) -> Columns:
    """The columns with what headings say of altitudes and accuracies, as yet of no system."""
    unit, heights = None, tuple[str, ...]()
    if "alt" in known:
        unit = told_meters(words[known["alt"]])
        others = [word for k, word in enumerate(words) if "alt" in known_columns([word]) and k != known["alt"]]
        heights = (words[known["alt"]], *others) if others else ()
    named = {what: words[known[what]] for what in DEVIATIONS if what in known}
    units = {what: meters_of(word) if read_heading(word).degrees is None else math.nan for what, word in named.items()}
    return Columns(known, None, unit, heights=heights, deviation_units=units)


def _with_angles(columns: Columns, rows: Sequence[Row], system: str | None, file: Path) -> Columns:
    """The columns of latitudes and longitudes, without x and y beside them (of a local or a projected system); of
    `system`, or else that of the rows, where it is of another datum than WGS 84. Raises CaptureError."""
    (_, words), *body = rows
    angles = {what: read_heading(words[columns.where[what]]) for what in ("lat", "lon")}
    codes = _codes_of_rows(body, columns.where.get("system")) if system is None else [system]
    datums = [code for code in codes if _is_datum(code, file)]
    if datums and len(codes) > 1:
        raise _several_systems(codes, file)
    return columns._replace(
        where={what: k for what, k in columns.where.items() if what not in ("x", "y")},
        system=next(iter(datums), None),
        across_units=(angles["lat"].degrees, angles["lon"].degrees),
        angles=angles,
        o_side=west_or_east(words),
    )


def _with_plane(columns: Columns, rows: Sequence[Row], system: str | None, file: Path) -> Columns:
    """The columns of x and y, of the system that the table or its rows name; longitudes and latitudes where neither
    does and they look like that. Raises CaptureError."""
    (_, words), *body = rows
    known = columns.where
    if system is None and "system" in known:
        codes = _codes_of_rows(body, known["system"])
        if len(codes) > 1:
            raise _several_systems(codes, file)
        system = next(iter(codes), None)
    if system is None and _are_degrees(body, known):
        note = "does not say what x and y are; they look like longitude and latitude, and are taken as that."
        return columns._replace(where={**known, "lon": known["x"], "lat": known["y"]}, note=note)
    x, y = words[known["x"]], words[known["y"]]
    if system is None:
        raise NoSystem(
            f"{file}: has the columns {x!r} and {y!r} but does not "
            "say of which coordinate system. Write its code as a first line of its own, such as EPSG:32633, or "
            f"give name,lat,lon,alt.{_local_remedy(_places_in(body, known['x'], known['y']))}",
            [row.words[known["name"]] for row in body if len(row.words) > known["name"]],
            are_positions="alt" in known or {read_heading(word).stem for word in (x, y)}.isdisjoint({"x", "y"}),
        )
    return columns._replace(system=system, across_units=(told_meters(x), told_meters(y)))


def _codes_of_rows(rows: Sequence[Row], k: int | None) -> list[str]:
    """The coordinate systems that a column names; none where there is no such column, or it is empty."""
    if k is None:
        return []
    words = {row.words[k].strip() for row in rows if k < len(row.words)} - {""}
    codes = ((word, re.fullmatch(r"(\d+)(?:\.0+)?", word)) for word in words)  # of pandas: 25832.0
    return sorted({f"EPSG:{code[1]}" if code else word for word, code in codes})


def _several_systems(codes: Sequence[str], file: Path) -> CaptureError:
    return CaptureError(
        f"{file}: names several coordinate systems ({', '.join(codes[:3])}). Make a table of each, or give "
        "name,lat,lon,alt."
    )


def _by_order(rows: Sequence[Row], system: str | None, file: Path) -> Columns:
    """The columns of a table that does not name them. Raises CaptureError for x and y of no known system."""
    words = rows[0].words
    order = {"name": 0, "alt": 3} if len(words) > 3 else {"name": 0}
    if len(words) > 8:  # ODM, Pix4D: name x y z, three angles and two accuracies
        order |= {"across": 7, "upwards": 8}
    if system is not None:
        return Columns({**order, "x": 1, "y": 2}, system)
    places = _places_in(rows, 1, 2)
    if _have_quaternions(rows) and not _are_on_land(places):
        raise HoldsPoses(f"{file}: holds poses: positions and quaternions without names of columns. {LOCAL_METERS}.")
    largest = np.nanmax(np.abs(places), axis=0, initial=0)
    if max(largest) > 180:
        raise NoSystem(
            f"{file}: names neither its columns nor the coordinate system of values such as {words[1]}, "
            f"{words[2]}. Write its code as a first line of its own, such as EPSG:32633.{_local_remedy(places)}",
            [row.words[0] for row in rows],
            are_positions=_are_places(rows),
        )
    swapped = largest[0] > 90
    where = {"lat": 2 if swapped else 1, "lon": 1 if swapped else 2}
    read = f"name, {'longitude, latitude' if swapped else 'latitude, longitude'}, altitude"
    more = ", ..., accuracies across and up" if "across" in order else ""
    note = "" if swapped and not more else f"names no columns; read as {read}{more}."
    return Columns({**order, **where}, None, note=note)


def _places_in(rows: Sequence[Row], x: int, y: int) -> np.ndarray:
    """The numbers [n, 2] in two columns, NaN for words that are none."""
    words = [(row.words[x], row.words[y]) for row in rows if len(row.words) > max(x, y)]
    return np.array([list(map(number_of, pair)) for pair in words], float).reshape(-1, 2)


def _local_remedy(places: np.ndarray) -> str:
    """What to say of coordinates [n, 2] that are too small for a projected system; empty for others."""
    known = places[np.isfinite(places).all(axis=1)]
    is_local = len(known) > 0 and np.abs(known).max() < _PROJECTED_FROM
    return f" {LOCAL_METERS}." if is_local else ""


def _are_on_land(places: np.ndarray) -> bool:
    """Whether numbers [n, 2] may be degrees of one flight, and not about 0, 0."""
    level = np.column_stack([places, np.full(len(places), np.nan)])
    known = places[np.isfinite(places).all(axis=1)]
    middle = np.median(known, axis=0) if len(known) else np.zeros(2)
    return not why_no_flight(level) and bool((np.abs(middle) >= NO_LAND_DEG).any())


def _have_quaternions(rows: Sequence[Row]) -> bool:
    """Whether rows of no headings hold x, y, z and a quaternion that turns. One that never turns may be codes: of a
    receiver's solution, of angles that nobody knew."""
    turns = np.array([[number_of(word) for word in row.words[4:8]] for row in rows if len(row.words) > 7], float)
    return len(turns) == len(rows) > 2 and are_quaternions(turns) and bool((np.ptp(turns, axis=0) > 0).any())


def _are_places(rows: Sequence[Row]) -> bool:
    """Whether rows of no headings hold x, y and z of a flight in metres of a projected system."""
    values = [[number_of(word) for word in row.words[1:4]] for row in rows if len(row.words) > 3]
    places = np.array(values, float).reshape(-1, 3)
    if len(places) < len(rows) or not np.isfinite(places).all():
        return False
    plane = places[:, :2]
    across, wide = np.median(np.abs(plane), axis=0), np.ptp(plane, axis=0).max()
    is_far = across.min() > _FLIGHT_FROM and across.max() > _PROJECTED_FROM
    return bool(is_far and 0 < wide < _FLIGHT_WIDE and (plane % 1 != 0).any())


def _is_datum(system: str, file: Path) -> bool:
    """Whether a line above latitudes and longitudes names a system of degrees other than WGS 84."""
    if re.fullmatch(r"(?i)(EPSG:)?(4326|4979)|WGS[ _]?84", system):
        return False
    try:
        to_geodetic(system, file)
    except CaptureError:  # not understood, or pyproj is not there: as before
        return False
    return is_in_degrees(system)


def _are_degrees(rows: Sequence[Row], known: Mapping[str, int]) -> bool:
    """Whether x and y are longitudes and latitudes of one place: as metres they would be one and the same point."""
    words = [[row.words[known[what]] if known[what] < len(row.words) else "" for what in ("x", "y")] for row in rows]
    places = np.array([[number_of(word) for word in each] for each in words if "" not in each]).reshape(-1, 2)
    return bool(np.isfinite(places).all() and (np.abs(places) < [180, 90]).all() and look_like_degrees(places))


def _has_numbers(row: Row) -> bool:
    return len(row.words) > 2 and all(math.isfinite(number_of(word)) or doubt_of(word) for word in row.words[1:3])
