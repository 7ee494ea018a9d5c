"""Tables of the positions of photographs, as programs and people write them.

`name,lat,lon,alt` under the names that Metashape, Pix4D, RealityScan, exiftool, DJI Terra and others give these,
in any order; ODM's geo.txt, whose first line names the coordinate system; rows without a header in Pix4D's order.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from vdgs.captures.angles import degrees_of_text
from vdgs.captures.column_headings import LENGTHS, Heading, read_heading
from vdgs.captures.coordinate_systems import (
    HEIGHTS_IN_METERS,
    ToGeodetic,
    datum_error,
    height_unit,
    in_units_of,
    is_in_degrees,
    join_definition,
    look_like_degrees,
    names_a_system,
    to_geodetic,
)
from vdgs.captures.table_columns import (
    NO_DATA,
    UNKNOWN,
    Row,
    has_time,
    heading_notes,
    known_columns,
    meters_of,
    number_of,
    parted_angles,
    plain_number,
    side_letter,
    told_meters,
    west_or_east,
    with_names,
    with_sides,
    with_units,
)
from vdgs.captures.text_tables import LOOKED_AT, Line, read_lines, rows_of
from vdgs.errors import CaptureError

#: What errors say of a track, which has a position for each moment.
BY_TIME = (
    "by time and not by photograph. Let `exiftool -geotag TRACK PHOTOGRAPHS`, or the receiver's own program, write the "
    "positions into the photographs."
)
#: How files begin that have positions but are no tables of them, and what to do.
_OTHERS = (
    (r"<gpx|<kml|<trainingcenter|^\$g[pnlab][a-z]{3},", f"is a track, {BY_TIME}"),
    (r"^% *(program|gpst|utc|jst)\b|^%.*latitude\(deg\)", f"is a solution of RTKLIB or Emlid, {BY_TIME}"),
    (r"<blocksexchange", "is BlocksExchange XML (DJI Terra, ContextCapture). Export the positions as text instead."),
    (r"<document\b", "is Metashape's XML. Export the reference as text instead (.txt, .csv), with a line of columns."),
    (r"\A<", "is XML. Export the positions as text instead, with the columns name,lat,lon,alt."),
    (
        r"^[{[]\s*[{\"\]]|^[{[]$",
        "is JSON. Export a table instead: `exiftool -csv -n -GPS* PHOTOGRAPHS`, or ODM's geo.txt.",
    ),
)
_DEVIATIONS = ("across", "upwards", "eastwards", "northwards")
#: Words of exiftool behind altitudes below the sea, and EXIF's numbers (3 below, over the sea and not the ellipsoid).
_BELOW = re.compile(r"below|negative|^[13]$", re.IGNORECASE)
_LEADING_NUMBER = re.compile(r"\s*([+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)")
_WORD = re.compile(r"[^\W\d_]+")
#: O behind an angle stands for east or for west.
_O = re.compile(r"\bO\b|(?<=[\d'\"″′°])O$|^O(?=\d)", re.IGNORECASE)
#: Degrees and minutes in one number, of which programs may have cut the zeros before the other angle of the row.
_NMEA = re.compile(r"\d{4,5}\.\d+")
#: DJI's list of moments (.MRK): one line for each photograph, by its number.
_MRK = re.compile(r"([-\d.]+),Lat\s+([-\d.]+),Lon\s+([-\d.]+),Ellh")


@dataclass(frozen=True)
class GpsRow:
    """A photograph's position in a table."""

    line: int
    name: str
    """As it is written there; in DJI's list of moments the photograph's number."""
    position: tuple[float, float, float]
    """Latitude and longitude in degrees, altitude in metres (NaN where the table has none)."""
    gps_std: tuple[float, float] | None = None
    """Across and upwards in metres, where the table says them."""


@dataclass(frozen=True)
class GpsTable:
    """The rows of a table that have a position."""

    rows: tuple[GpsRow, ...]
    numbered: bool = False
    """Whether rows are of the first, second, ... photograph, not of one by its name."""
    notes: tuple[str, ...] = ()
    datum_error_m: float = 0.0
    """How far all its places may be off by the datum of its system."""


class _Columns(NamedTuple):
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
    across_units: tuple[float, float] = (1.0, 1.0)
    """Metres (of angles degrees) in one of x and of y where their names say another unit, as `[km]`; 1 elsewhere."""
    angles: Mapping[str, Heading] = MappingProxyType({})
    """The headings of latitudes and longitudes."""
    o_side: str = ""
    """What O stands for, E or W, where the headings tell."""


def read_gps_table(file: Path) -> GpsTable:
    """The positions in a table. Raises CaptureError for a file that is none, that lacks a column, whose coordinates are
    of an unknown system, or that holds a value that is no position."""
    lines = read_lines(file)
    if any(_MRK.search(line.text) for line in lines):
        return _moments(lines, file)
    head = "\n".join(line.text for line in lines[:LOOKED_AT]).lower()
    for begins, what in _OTHERS:
        if re.search(begins, head, re.MULTILINE):
            raise CaptureError(f"{file}: {what}")
    system, body = None, list[Line]()
    definition, count = join_definition([_after_colon(line.text) for line in lines])
    for line in [Line(lines[0].number, definition), *lines[count:]] if count > 1 else lines:
        if system is None and not body and names_a_system(_after_colon(line.text)):
            system = _after_colon(line.text)
        else:
            body.append(line)
    body = [line for line in body if not line.text.startswith("#") or _is_header(line)]
    body = [Line(line.number, line.text.lstrip("# ") if k == 0 else line.text) for k, line in enumerate(body)]
    if not body:
        raise CaptureError(f"{file}: is empty. Write a first line `name,lat,lon,alt` and one for each photograph.")
    rows = with_units(rows_of(body))
    head_row, count = rows[0], len(rows)
    columns, rows = _columns(rows, system, file)
    if not rows:
        raise CaptureError(f"{file}: names its columns but holds no rows. Write one for each photograph.")
    placed = [row for row in rows if _has_place(row, columns)]
    if not placed:
        raise CaptureError(f"{file}: none of its {len(rows)} rows has a position. Export the table once it has them.")
    positions, system = _positions(placed, columns, file)
    found = [
        GpsRow(row.number, row.words[columns.where["name"]], position, _deviations(row, columns))
        for row, position in zip(placed, positions, strict=True)
    ]
    notes = list[str]()
    notes += [f"{file.name} {columns.note}"] if columns.note else []
    if len(rows) < count:
        doubts = heading_notes(head_row.words, columns.where, [row.words for row in rows])
        notes += [f"{file.name}: {doubt}" for doubt in doubts]
    if columns.heights:
        read, *others = map(repr, columns.heights)
        notes.append(f"{file.name}: altitudes are those of the column {read}, not of {', '.join(others)}.")
    system = system if columns.altitude_unit in (None, 1) else system.removesuffix(HEIGHTS_IN_METERS)
    if doubt := system.partition("; ")[2]:
        notes.append(f"{file.name}: {doubt}.")
    datum_error_m, converted = 0.0, ""
    if columns.system is not None:
        datum_error_m, converted = datum_error(columns.system, np.array(positions))
    notes += [f"{file.name}: positions are {converted} (maps in that system lose nothing)."] if converted else []
    if len(placed) < len(rows):
        notes.append(f"{file.name}: {len(rows) - len(placed)} of {len(rows)} rows have no position; not used.")
    return GpsTable(tuple(found), notes=tuple(notes), datum_error_m=datum_error_m)


def _after_colon(text: str) -> str:
    """A line without the sign of a comment and without `CoordinateSystem:` (Metashape) before the system."""
    plain = text.lstrip("# ").strip()
    head, colon, rest = plain.partition(":")
    return rest.strip() if colon and re.fullmatch(r"(?i)coordinate ?system|crs|srs|projection", head.strip()) else plain


def _is_header(line: Line) -> bool:
    """Whether a line that begins like a comment names the columns (Metashape, RealityScan)."""
    known = known_columns(rows_of([Line(line.number, line.text.lstrip("# "))])[0].words)
    return len(known) > 1 and ("name" in known or "id" in known)


def _columns(rows: list[Row], system: str | None, file: Path) -> tuple[_Columns, list[Row]]:
    """The columns and the rows below their names. Raises CaptureError."""
    below = [row.words for row in rows[1:]]
    known = with_sides(with_names(known_columns(rows[0].words), below), below)
    if {"lat", "lon"} <= set(known) and (parts := parted_angles(rows[0].words)):
        raise CaptureError(
            f"{file}: has minutes and seconds in columns of their own ({', '.join(map(repr, parts))}). Write each "
            "angle into one column: name,lat,lon,alt with degrees such as -33.51234, or words such as 33 30 44.4 S."
        )
    unit = told_meters(rows[0].words[known["alt"]]) if "alt" in known else None
    others = [word for k, word in enumerate(rows[0].words) if "alt" in known_columns([word]) and k != known["alt"]]
    heights = (rows[0].words[known["alt"]], *others) if others else ()
    named = {what: rows[0].words[known[what]] for what in _DEVIATIONS if what in known}
    units = {what: meters_of(word) if read_heading(word).degrees is None else math.nan for what, word in named.items()}
    if {"name", "lat", "lon"} <= set(known):
        angles = {what: read_heading(rows[0].words[known[what]]) for what in ("lat", "lon")}
        latitude, longitude = (1.0 if angle.degrees is None else angle.degrees for angle in angles.values())
        datum = system if system is not None and _is_datum(system, file) else None
        columns = _Columns(
            known, datum, unit, heights=heights, deviation_units=units, across_units=(latitude, longitude),
            angles=angles, o_side=west_or_east(rows[0].words),
        )  # fmt: skip
        return columns, rows[1:]
    if {"lat", "lon"} <= set(known):
        found = ", ".join(word for word in rows[0].words if word)
        remedy = f"It is {BY_TIME}" if has_time(rows[0].words) else "Call the column that has them `name`, or add it."
        raise CaptureError(f"{file}: has positions but no column of photographs' names (found: {found}). {remedy}")
    if {"name", "x", "y"} <= set(known):
        if system is None and "system" in known and len(rows) > 1:
            k = known["system"]
            codes = sorted({row.words[k].strip() for row in rows[1:] if k < len(row.words)} - {""})
            if len(codes) > 1:
                raise CaptureError(
                    f"{file}: names several coordinate systems ({', '.join(codes[:3])}). Make a table of each, or give "
                    "name,lat,lon,alt."
                )
            system = f"EPSG:{codes[0]}" if codes and codes[0].isdecimal() else next(iter(codes), None)
        if system is None and _are_degrees(rows[1:], known):
            note = "does not say what x and y are; they look like longitude and latitude, and are taken as that."
            places = {**known, "lon": known["x"], "lat": known["y"]}
            return _Columns(places, None, unit, heights=heights, deviation_units=units, note=note), rows[1:]
        if system is None:
            raise CaptureError(
                f"{file}: has the columns {rows[0].words[known['x']]!r} and {rows[0].words[known['y']]!r} but does not "
                "say of which coordinate system. Write its code as a first line of its own, such as EPSG:32633, or "
                "give name,lat,lon,alt."
            )
        across = meters_of(rows[0].words[known["x"]]), meters_of(rows[0].words[known["y"]])
        return _Columns(known, system, unit, heights=heights, deviation_units=units, across_units=across), rows[1:]
    if not _has_numbers(rows[0]):
        found = ", ".join(sorted(word for word in rows[0].words if word)) or "nothing"
        marks = "" if system is None else " A list of control points is given as --gcp."
        if system is None and not known and len(rows) > 1 and _has_numbers(rows[1]):
            marks = " If it is to name a coordinate system, write its code, such as EPSG:32633."
        raise CaptureError(
            f"{file}: needs a first line that names the columns name,lat,lon,alt (found: {found}).{marks}"
        )
    order = {"name": 0, "alt": 3} if len(rows[0].words) > 3 else {"name": 0}
    if len(rows[0].words) > 8:  # ODM, Pix4D: name x y z, three angles and two accuracies
        order |= {"across": 7, "upwards": 8}
    if system is not None:
        return _Columns({**order, "x": 1, "y": 2}, system), rows
    values = [number_of(row.words[k]) for row in rows for k in (1, 2) if len(row.words) > k]
    firsts, seconds = np.abs(np.array(values[::2], float)), np.abs(np.array(values[1::2], float))
    if max(firsts.max(initial=0), seconds.max(initial=0)) > 180:
        raise CaptureError(
            f"{file}: names neither its columns nor the coordinate system of values such as {rows[0].words[1]}, "
            f"{rows[0].words[2]}. Write its code as a first line of its own, such as EPSG:32633."
        )
    swapped = firsts.max(initial=0) > 90
    places = {"lat": 2 if swapped else 1, "lon": 1 if swapped else 2}
    read = f"name, {'longitude, latitude' if swapped else 'latitude, longitude'}, altitude"
    more = ", ..., accuracies across and up" if "across" in order else ""
    note = "" if swapped and not more else f"names no columns; read as {read}{more}."
    return _Columns({**order, **places}, None, note=note), rows


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
    return len(row.words) > 2 and all(math.isfinite(number_of(word)) for word in row.words[1:3])


def _word(row: Row, columns: _Columns, what: str) -> str:
    k = columns.where.get(what)
    return row.words[k].strip() if k is not None and k < len(row.words) else ""


def _has_place(row: Row, columns: _Columns) -> bool:
    both = ("x", "y") if "x" in columns.where and columns.system is not None else ("lat", "lon")
    return bool(_word(row, columns, "name")) and all(_word(row, columns, what).lower() not in UNKNOWN for what in both)


def _positions(rows: Sequence[Row], columns: _Columns, file: Path) -> tuple[list[tuple[float, float, float]], str]:
    """Latitude, longitude and altitude of each row, and the name of the system that they are given in; "" where the
    table names none. Raises CaptureError."""
    if columns.system is None:
        return _geodetic(rows, columns, file), ""
    change, name = to_geodetic(columns.system, file)
    # Here, once: PROJ takes tens of milliseconds to read a system.
    columns = columns._replace(system_altitude_unit=height_unit(columns.system))
    if "x" in columns.where:
        return _projected(rows, columns, change, name, file), name
    positions = _geodetic(rows, columns, file)
    changed = change(np.array(positions)[:, [1, 0, 2]] / [1, 1, columns.system_altitude_unit])
    return [(float(a), float(b), c) for (a, b, _), (*_, c) in zip(changed, positions, strict=True)], name


def _geodetic(rows: Sequence[Row], columns: _Columns, file: Path) -> list[tuple[float, float, float]]:
    found = []
    for row in rows:
        angles = [
            _angle(row, columns, what, reference, axis, file)
            for what, reference, axis in (("lat", "latref", "latitude"), ("lon", "lonref", "longitude"))
        ]
        if None in angles:
            words = [_word(row, columns, what) for what in ("lat", "lon", "alt")]
            raise CaptureError(f"{file}: line {row.number}: {words} are not numbers. Mend the row.")
        latitude, longitude = ((angle or 0.0) * unit for angle, unit in zip(angles, columns.across_units, strict=True))
        position = (latitude, longitude, _altitude(row, columns, file))
        try:
            check_geodetic(position, file, f"line {row.number}: ")
        except CaptureError as error:
            raise CaptureError(f"{error}{_other_degrees(latitude, longitude)}") from None
        found.append(position)
    return found


def _other_degrees(latitude: float, longitude: float) -> str:
    """A question about how numbers that are no degrees may be meant."""
    if abs(latitude) > 1e6 and abs(latitude) <= 9e8 and abs(longitude) <= 1.8e9:
        return " Are they degrees times 10,000,000, as in logs of autopilots? Divide them."
    if 90 < abs(latitude) < 9000 and abs(longitude) < 18000 and max(abs(latitude) % 100, abs(longitude) % 100) < 60:
        return " Are they degrees and minutes in one number (ddmm.mmmm, as in NMEA)? Write N or S, E or W behind them."
    return ""


def _angle(row: Row, columns: _Columns, what: str, reference: str, axis: str, file: Path) -> float | None:
    """An angle of a row in the unit of its column; its own side counts before that of another column or the heading's.
    Raises CaptureError for numbers that the heading says to be no decimal ones, for an O that may be either side, and
    for words in a column of sides that are none.
    """
    word, side_word, heading = _word(row, columns, what), _word(row, columns, reference), columns.angles.get(what)
    word = _WORD.sub(lambda match: side_letter(match[0], reference) or match[0], word)
    if _O.search(word) or _O.search(side_word):
        if not columns.o_side:
            raise CaptureError(
                f"{file}: line {row.number}: O is west (oeste, ouest, ovest) or east (Ost). Write W or E instead."
            )
        word, side_word = _O.sub(columns.o_side, word), _O.sub(columns.o_side, side_word)
    if word.count(",") == 1 and "." not in word:
        word = word.replace(",", ".")
    side_word = _side(side_word, reference, axis, f"{file}: line {row.number}") or (
        heading.side if heading is not None else ""
    )
    try:
        number = float(word)
        read: tuple[float, bool] | None = (number, False)
        in_minutes = any(_NMEA.fullmatch(_word(row, columns, each)) for each in ("lat", "lon"))
        if side_word and in_minutes:
            read = degrees_of_text(f"{abs(number) // 100:.0f} {abs(number) % 100:.9f} {side_word}", axis) or read
        elif heading is not None and heading.packed:
            raise CaptureError(
                f"{file}: line {row.number}: {axis} {word}: degrees, minutes and seconds in one number are not read. "
                "Write degrees such as -33.51234, or words such as 33 30 44.4 S."
            )
    except ValueError:
        read = degrees_of_text(word, axis)
        if read is not None and heading is not None and heading.side and read[1]:
            side_word = ""
    if read is None:
        return None
    side = degrees_of_text(f"{abs(read[0])} {side_word}", axis)
    return side[0] if side is not None and side[1] else read[0]


def _side(word: str, reference: str, axis: str, where: str) -> str:
    """N, S, E or W by the word of a column of sides; nothing where it is empty. Raises CaptureError."""
    if word.lower() in UNKNOWN:
        return ""
    positive, negative = ("N", "S") if axis == "latitude" else ("E", "W")
    for said in (word, word.split()[0]):  # `South latitude`
        if letter := side_letter(said, reference):
            return letter
        side = degrees_of_text(f"1 {said}", axis)
        if side is not None and side[1]:
            return positive if side[0] > 0 else negative
    raise CaptureError(f"{where}: {word!r} is no side of a {axis}. Write {positive} or {negative} instead.")


def _altitude(row: Row, columns: _Columns, file: Path) -> float:
    """The altitude of a row in metres, NaN where it has none."""
    word = _word(row, columns, "alt")
    if word.lower() in UNKNOWN:
        return math.nan
    word = plain_number(word)
    number = _LEADING_NUMBER.match(word)
    behind = read_heading(f"({word[number.end() :]})") if number is not None else None
    if number is None or behind is None or behind.unread or {*behind.meanings} - {*LENGTHS, "sea", "ellipsoid", ""}:
        raise CaptureError(f"{file}: line {row.number}: the altitude {word!r} is not a number. Mend the row.")
    value = float(number[1].replace(",", "."))
    if value in NO_DATA:
        return math.nan
    value *= behind.meters if behind.units else columns.altitude_unit or columns.system_altitude_unit
    below = _BELOW.search(word[number.end() :]) or _BELOW.search(_word(row, columns, "altref"))
    return -abs(value) if below else value


def _projected(
    rows: Sequence[Row], columns: _Columns, change: ToGeodetic, system: str, file: Path
) -> list[tuple[float, float, float]]:
    places = []
    for row in rows:
        x, y = (number_of(_word(row, columns, what)) for what in ("x", "y"))
        if not (math.isfinite(x) and math.isfinite(y)):
            words = [_word(row, columns, what) for what in ("x", "y", "alt")]
            raise CaptureError(f"{file}: line {row.number}: {words} are not numbers. Mend the row.")
        places.append((x, y, _altitude(row, columns, file)))
    given = np.array(places)
    across = [in_units_of(columns.system or "", unit, file) for unit in columns.across_units]
    given *= [*across, 1 / columns.system_altitude_unit]
    known = np.isfinite(given[:, 2])
    changed = change(np.where(np.isfinite(given), given, 0.0))
    changed[~known, 2] = math.nan
    for row, place, position in zip(rows, places, changed, strict=True):
        if not np.isfinite(position[:2]).all() or abs(position[0]) > 90:
            raise CaptureError(
                f"{file}: line {row.number}: {place[0]:.10g}, {place[1]:.10g} is no place in {system}. Is it the right "
                "system, and x (east) before y (north)?"
            )
    return [(float(a), float(b), float(c)) for a, b, c in changed]


def _deviations(row: Row, columns: _Columns) -> tuple[float, float] | None:
    across, upwards, *sides = (
        number_of(_word(row, columns, what)) * columns.deviation_units.get(what, 1.0) for what in _DEVIATIONS
    )
    if "across" not in columns.where:
        across = float(np.max(sides))  # NaN where one of them is not known
    return (across, upwards) if 0 < across < 1000 and 0 < upwards < 1000 else None


def _moments(lines: Sequence[Line], file: Path) -> GpsTable:
    """DJI's .MRK: the number of each photograph, its place, and its deviations north, east and up."""
    rows = []
    for number, text in lines:
        match = _MRK.search(text)
        if match is None or float(match[1]) == float(match[2]) == 0:
            continue
        words = text.split()
        position = (float(match[1]), float(match[2]), float(match[3]))
        check_geodetic(position, file, f"line {number}: ")
        spread = [number_of(word) for word in re.split(r"[,\s]+", text[match.end() :].strip()) if word][:3]
        known = len(spread) == 3 and all(0 < value < 100 for value in spread)
        deviations = (max(spread[:2]), spread[2]) if known else None
        rows.append(GpsRow(number, words[0], position, deviations))
    without = len(lines) - len(rows)
    notes = (f"{file.name}: {without} of {len(lines)} rows have no position; not used.",) if without else ()
    return GpsTable(tuple(rows), numbered=True, notes=notes)


def check_geodetic(position: tuple[float, ...], file: Path, where: str = "") -> None:
    """Raise CaptureError for what is no place on Earth; an altitude may be NaN."""
    latitude, longitude, altitude = position
    high = math.isinf(altitude) or abs(altitude) >= 1e5
    if not (abs(latitude) <= 90 and abs(longitude) <= 360) or high:
        raise CaptureError(
            f"{file}: {where}latitude {latitude}, longitude {longitude}, altitude {altitude} is no place "
            "on Earth. Degrees and metres are expected."
        )
