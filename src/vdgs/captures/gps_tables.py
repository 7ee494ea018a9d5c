"""Tables of the positions of photographs, as programs and people write them.

`name,lat,lon,alt` under the names that Metashape, Pix4D, RealityScan, exiftool, DJI Terra and others give these,
in any order; ODM's geo.txt, whose first line names the coordinate system; rows without a header in Pix4D's order.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vdgs.captures.angles import SIDES, degrees_of_text, says_minus
from vdgs.captures.column_headings import LENGTHS, Heading, read_heading
from vdgs.captures.column_units import believed_units, in_units_of, named_in_units
from vdgs.captures.coordinate_systems import (
    ToGeodetic,
    datum_error,
    height_unit,
    is_geocentric,
    outside_area,
    to_geodetic,
)
from vdgs.captures.decimal_signs import doubt_of
from vdgs.captures.flight_extent import LOCAL_METERS
from vdgs.captures.gps_columns import BY_TIME, DEVIATIONS, Columns, HoldsPoses, read_columns
from vdgs.captures.system_names import join_definition, names_a_system
from vdgs.captures.table_columns import (
    NO_DATA,
    UNKNOWN,
    Row,
    heading_notes,
    known_columns,
    number_of,
    plain_number,
    side_letter,
    with_units,
)
from vdgs.captures.text_tables import LARGEST_ALTITUDE, LOOKED_AT, Line, read_lines, rows_of, with_points_parted
from vdgs.errors import CaptureError

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
#: The headings of AirSim's record.
_AIRSIM = re.compile(r"\bpos_x[\s,;]+pos_y[\s,;]+pos_z\b")
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
#: Coordinates of local systems are smaller, in metres, and those of projected ones larger (choice).
_LARGEST_LOCAL = 20_000.0
#: How large numbers can be in columns that no heading names: name x y altitude.
_LARGEST_BY_ORDER = {1: math.inf, 2: math.inf, 3: LARGEST_ALTITUDE}
#: What columns say that have no heading.
_NO_HEADING = Heading("", "", (), ())


class _Axis(NamedTuple):
    """An angle, and the columns of it and of its sides."""

    name: str
    column: str
    side_column: str


_AXES = (_Axis("latitude", "lat", "latref"), _Axis("longitude", "lon", "lonref"))


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


def read_gps_table(file: Path) -> GpsTable:
    """The positions in a table. Raises CaptureError for a file that is none, that lacks a column, whose coordinates are
    of an unknown system, or that holds a value that is no position."""
    lines = read_lines(file)
    if any(_MRK.search(line.text) for line in lines):
        return _moments(lines, file)
    _refuse_others(lines, file)
    system, body = _system_and_body(lines)
    if not body:
        raise CaptureError(f"{file}: is empty. Write a first line `name,lat,lon,alt` and one for each photograph.")
    all_rows = with_units(with_points_parted(rows_of(body, _LARGEST_BY_ORDER)))
    columns, rows = read_columns(all_rows, system, file)
    if not rows:
        raise CaptureError(f"{file}: names its columns but holds no rows. Write one for each photograph.")
    placed = [row for row in rows if _has_place(row, columns)]
    if not placed:
        raise CaptureError(f"{file}: none of its {len(rows)} rows has a position. Export the table once it has them.")
    positions, columns, system_name = _positions(placed, columns, file)
    found = [
        GpsRow(row.number, row.words[columns.where["name"]], position, _deviations(row, columns))
        for row, position in zip(placed, positions, strict=True)
    ]
    headings = all_rows[0].words if len(rows) < len(all_rows) else None
    notes = _column_notes(columns, headings, rows, file.name)
    notes += [f"{file.name}: {note}" for note in _unit_notes(columns, system_name)]
    datum_error_m, converted = 0.0, ""
    if columns.system is not None:
        datum_error_m, converted = datum_error(columns.system, np.array(positions))
        notes += [f"{file.name}: {said}" for said in outside_area(columns.system, np.array(positions))]
    notes += [f"{file.name}: positions are {converted} (maps in that system lose nothing)."] if converted else []
    if len(placed) < len(rows):
        notes.append(f"{file.name}: {len(rows) - len(placed)} of {len(rows)} rows have no position; not used.")
    return GpsTable(tuple(found), notes=tuple(notes), datum_error_m=datum_error_m)


def _refuse_others(lines: Sequence[Line], file: Path) -> None:
    """Raise CaptureError for a file that has positions but is no table of them."""
    head = "\n".join(line.text for line in lines[:LOOKED_AT]).lower()
    for begins, what in _OTHERS:
        if re.search(begins, head, re.MULTILINE):
            raise CaptureError(f"{file}: {what}")
    if _AIRSIM.search(head):
        raise HoldsPoses(
            f"{file}: holds poses of AirSim, in metres north, east and down: z points down. {LOCAL_METERS}."
        )


def _system_and_body(lines: Sequence[Line]) -> tuple[str | None, list[Line]]:
    """The coordinate system that a line above the table names, and the lines of the table without comments."""
    system, body = None, list[Line]()
    definition, count = join_definition([_after_colon(line.text) for line in lines])
    for line in [Line(lines[0].number, definition), *lines[count:]] if count > 1 else lines:
        if system is None and not body and names_a_system(_after_colon(line.text)):
            system = _after_colon(line.text)
        else:
            body.append(line)
    body = [line for line in body if not line.text.startswith("#") or _is_header(line)]
    return system, [Line(line.number, line.text.lstrip("# ") if k == 0 else line.text) for k, line in enumerate(body)]


def _column_notes(columns: Columns, headings: list[str] | None, rows: Sequence[Row], table: str) -> list[str]:
    """How columns are read that do not say it themselves, and what of the headings is not understood."""
    notes = [f"{table} {columns.note}"] if columns.note else []
    if headings is not None:
        doubts = heading_notes(headings, columns.where, [row.words for row in rows])
        notes += [f"{table}: {doubt}" for doubt in doubts]
    return notes


def _unit_notes(columns: Columns, system: str) -> list[str]:
    """The unit of x and y where it is in doubt, which of several altitudes is read, and what the name of the system
    says in doubt of it."""
    notes = [columns.unit_note] if columns.unit_note else []
    if columns.heights:
        read, *others = map(repr, columns.heights)
        notes.append(f"altitudes are those of the column {read}, not of {', '.join(others)}.")
    if doubt := named_in_units(system, columns.across_units, columns.altitude_unit).partition("; ")[2]:
        notes.append(f"{doubt}.")
    return notes


def _after_colon(text: str) -> str:
    """A line without the sign of a comment and without `CoordinateSystem:` (Metashape) before the system."""
    plain = text.lstrip("# ").strip()
    head, colon, rest = plain.partition(":")
    return rest.strip() if colon and re.fullmatch(r"(?i)coordinate ?system|crs|srs|projection", head.strip()) else plain


def _is_header(line: Line) -> bool:
    """Whether a line that begins like a comment names the columns (Metashape, RealityScan)."""
    known = known_columns(rows_of([Line(line.number, line.text.lstrip("# "))])[0].words)
    return len(known) > 1 and ("name" in known or "id" in known)


def _word(row: Row, columns: Columns, what: str) -> str:
    k = columns.where.get(what)
    return row.words[k].strip() if k is not None and k < len(row.words) else ""


def _has_place(row: Row, columns: Columns) -> bool:
    both = ("x", "y") if "x" in columns.where and columns.system is not None else ("lat", "lon")
    return bool(_word(row, columns, "name")) and all(_word(row, columns, what).lower() not in UNKNOWN for what in both)


def _positions(
    rows: Sequence[Row], columns: Columns, file: Path
) -> tuple[list[tuple[float, float, float]], Columns, str]:
    """Latitude, longitude and altitude of each row, the columns with the units that are believed, and the name of the
    system that they are given in; "" where the table names none. Raises CaptureError."""
    system = columns.system
    if system is None:
        return _geodetic(rows, columns, file), columns, ""
    change, name = to_geodetic(system, file)
    # Here, once: PROJ takes tens of milliseconds to read a system.
    columns = columns._replace(system_altitude_unit=height_unit(system))
    if "x" in columns.where:
        across = np.array([[number_of(_word(row, columns, what)) for what in ("x", "y")] for row in rows])
        units, note = believed_units(system, columns.across_units, across, file)
        columns = columns._replace(across_units=units, unit_note=note)
        return _projected(rows, columns, change, name, file), columns, name
    positions = _geodetic(rows, columns, file)
    given = np.array(positions)[:, [1, 0, 2]] / [1, 1, columns.system_altitude_unit]
    changed = _changed(given, change, rows, columns, f"no place in {name}. Is it the right system?", file)
    return [(float(a), float(b), c) for (a, b, _), (*_, c) in zip(changed, positions, strict=True)], columns, name


def _geodetic(rows: Sequence[Row], columns: Columns, file: Path) -> list[tuple[float, float, float]]:
    found = []
    for row in rows:
        angles = [_angle(row, columns, axis, file) for axis in _AXES]
        if None in angles:
            words = [_word(row, columns, what) for what in ("lat", "lon", "alt")]
            raise CaptureError(f"{file}: line {row.number}: {words} are not numbers. Mend the row.")
        latitude, longitude = (
            (angle or 0.0) * (1.0 if unit is None else unit)
            for angle, unit in zip(angles, columns.across_units, strict=True)
        )
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
    asked = ""
    if 90 < abs(latitude) < 9000 and abs(longitude) < 18000 and max(abs(latitude) % 100, abs(longitude) % 100) < 60:
        asked = " Are they degrees and minutes in one number (ddmm.mmmm, as in NMEA)? Write N or S, E or W behind them."
    is_local = max(abs(latitude), abs(longitude)) < _LARGEST_LOCAL
    return f"{asked} Are they metres? {LOCAL_METERS}." if is_local else asked


def _angle(row: Row, columns: Columns, axis: _Axis, file: Path) -> float | None:
    """An angle of a row in the unit of its column; its own side counts before that of another column or the heading's.
    Raises CaptureError for numbers that the heading says to be no decimal ones, for an O that may be either side, for
    words in a column of sides that are none, and for a sign against a side.
    """
    where, heading = f"{file}: line {row.number}", columns.angles.get(axis.column, _NO_HEADING)
    word, side_word = _words_of_angle(row, columns, axis, where)
    side_word = _side(side_word, axis, where)
    _check_sign(word, side_word, axis, where)
    side_word = side_word or heading.side
    try:
        number = float(word)
    except ValueError:
        read = degrees_of_text(word, axis.name)
        if heading.side and read is not None and read[1]:
            side_word = ""
    else:
        in_minutes = bool(side_word) and _has_minutes(row, columns)
        if heading.packed and not in_minutes:
            raise CaptureError(
                f"{where}: {axis.name} {word}: degrees, minutes and seconds in one number are not read. "
                "Write degrees such as -33.51234, or words such as 33 30 44.4 S."
            )
        read = (_degrees_and_minutes(number, side_word, axis) if in_minutes else None) or (number, False)
    if read is None:
        return None
    side = degrees_of_text(f"{abs(read[0])} {side_word}", axis.name)
    return side[0] if side is not None and side[1] else read[0]


def _check_sign(word: str, side: str, axis: _Axis, where: str) -> None:
    """Raise CaptureError for an angle below zero whose side, in its text or in its own column, is north or east."""
    value = degrees_of_text(word.lstrip("-\u2212 "), axis.name) if says_minus(word) else None
    if value is not None and value[0] > 0 and (value[1] or side in ("N", "E")):
        one, other = SIDES[axis.name]
        plain = word.lstrip("-\u2212 ").rstrip(f"{other} ")
        raise CaptureError(
            f"{where}: {axis.name} {word} {side}".rstrip()
            + f": its sign says {one}, its side {other}. Write {plain} {one} or {plain} {other}."
        )


def _has_minutes(row: Row, columns: Columns) -> bool:
    """Whether one of the angles of a row is degrees and minutes in one number."""
    return any(_NMEA.fullmatch(_word(row, columns, axis.column)) for axis in _AXES)


def _degrees_and_minutes(number: float, side: str, axis: _Axis) -> tuple[float, bool] | None:
    return degrees_of_text(f"{abs(number) // 100:.0f} {abs(number) % 100:.9f} {side}", axis.name)


def _words_of_angle(row: Row, columns: Columns, axis: _Axis, where: str) -> tuple[str, str]:
    """The words of an angle and of its side, sides in the angle as one letter, O as what it stands for, and a point
    before decimals."""
    word, side_word = _word(row, columns, axis.column), _word(row, columns, axis.side_column)
    word = _WORD.sub(lambda match: side_letter(match[0], axis.side_column) or match[0], word)
    if _O.search(word) or _O.search(side_word):
        if not columns.o_side:
            raise CaptureError(f"{where}: O is west (oeste, ouest, ovest) or east (Ost). Write W or E instead.")
        word, side_word = _O.sub(columns.o_side, word), _O.sub(columns.o_side, side_word)
    return word.replace(",", ".") if word.count(",") == 1 and "." not in word else word, side_word


def _side(word: str, axis: _Axis, where: str) -> str:
    """N, S, E or W by the word of a column of sides; nothing where it is empty. Raises CaptureError."""
    if word.lower() in UNKNOWN:
        return ""
    positive, negative = ("N", "S") if axis.name == "latitude" else ("E", "W")
    for said in (word, word.split()[0]):  # `South latitude`
        if letter := side_letter(said, axis.side_column):
            return letter
        side = degrees_of_text(f"1 {said}", axis.name)
        if side is not None and side[1]:
            return positive if side[0] > 0 else negative
    raise CaptureError(f"{where}: {word!r} is no side of a {axis.name}. Write {positive} or {negative} instead.")


def _altitude(row: Row, columns: Columns, file: Path) -> float:
    """The altitude of a row in metres, NaN where it has none."""
    word = _word(row, columns, "alt")
    if word.lower() in UNKNOWN:
        return math.nan
    digits = re.match(r"[^A-Za-z(]*", word)
    bare = digits[0].rstrip() if digits else ""
    word = plain_number(bare) + word[len(bare) :]
    number = _LEADING_NUMBER.match(word)
    behind = read_heading(f"({word[number.end() :]})") if number is not None else None
    if number is None or behind is None or behind.unread or {*behind.meanings} - {*LENGTHS, "sea", "ellipsoid", ""}:
        raise CaptureError(f"{file}: line {row.number}: the altitude {word!r} is not a number. Mend the row.")
    if doubt := doubt_of(number[1], LARGEST_ALTITUDE):
        raise CaptureError(f"{file}: line {row.number}: the altitude {doubt}")
    value = float(number[1].replace(",", "."))
    if value in NO_DATA:
        return math.nan
    value *= behind.meters if behind.units else columns.altitude_unit or columns.system_altitude_unit
    below = _BELOW.search(word[number.end() :]) or _BELOW.search(_word(row, columns, "altref"))
    return -abs(value) if below else value


def _projected(
    rows: Sequence[Row], columns: Columns, change: ToGeodetic, system: str, file: Path
) -> list[tuple[float, float, float]]:
    places = []
    for row in rows:
        x, y = (number_of(_word(row, columns, what)) for what in ("x", "y"))
        if not (math.isfinite(x) and math.isfinite(y)):
            words = [_word(row, columns, what) for what in ("x", "y", "alt")]
            if doubt := doubt_of(words[0]) or doubt_of(words[1]):
                raise CaptureError(f"{file}: line {row.number}: a coordinate {doubt}")
            raise CaptureError(f"{file}: line {row.number}: {words} are not numbers. Mend the row.")
        places.append((x, y, _altitude(row, columns, file)))
    given = np.array(places)
    across = [in_units_of(columns.system or "", unit, file) for unit in columns.across_units]
    given *= [*across, 1 / columns.system_altitude_unit]
    doubt = f"no place in {system}. Is it the right system, and x (east) before y (north)?"
    return [(float(a), float(b), float(c)) for a, b, c in _changed(given, change, rows, columns, doubt, file)]


def _changed(
    given: np.ndarray, change: ToGeodetic, rows: Sequence[Row], columns: Columns, doubt: str, file: Path
) -> np.ndarray:
    """Latitude, longitude and height [n, 3] of places in the units of a system; heights that are not known (NaN) stay
    so. Raises CaptureError, for no place on Earth with what it is in words."""
    known = np.isfinite(given[:, 2])
    if not known.all() and is_geocentric(columns.system or ""):
        raise CaptureError(
            f"{file}: line {rows[int(np.argmin(known))].number}: has no z, and {columns.system} counts from the middle "
            "of the Earth: x and y alone are no place. Mend the row, or leave it out."
        )
    changed = change(np.where(np.isfinite(given), given, 0.0))
    changed[~known, 2] = math.nan
    for row, place, position in zip(rows, given.tolist(), changed, strict=True):
        if not np.isfinite(position[:2]).all() or abs(position[0]) > 90:
            raise CaptureError(f"{file}: line {row.number}: {place[0]:.10g}, {place[1]:.10g} is {doubt}")
    return changed


def _deviations(row: Row, columns: Columns) -> tuple[float, float] | None:
    across, upwards, *sides = (
        number_of(_word(row, columns, what)) * columns.deviation_units.get(what, 1.0) for what in DEVIATIONS
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
