"""Tables of the positions of photographs, as programs and people write them.

`name,lat,lon,alt` under the names that Metashape, Pix4D, RealityScan, exiftool, DJI Terra and others give these,
in any order; ODM's geo.txt, whose first line names the coordinate system; rows without a header in Pix4D's order.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from vdgs.captures.angles import degrees_of_text
from vdgs.captures.coordinate_systems import names_a_system, to_geodetic
from vdgs.captures.text_tables import LOOKED_AT, Line, Row, read_lines, rows_of
from vdgs.errors import CaptureError

_BY_TIME = (
    "by time and not by photograph. Let `exiftool -geotag TRACK PHOTOGRAPHS`, or the receiver's own program, write the "
    "positions into the photographs."
)
#: How files begin that have positions but are no tables of them, and what to do.
_OTHERS = (
    (r"<gpx|<kml|<trainingcenter|^\$g[pnlab][a-z]{3},", f"is a track, {_BY_TIME}"),
    (r"^% *(program|gpst|utc|jst)\b|^%.*latitude\(deg\)", f"is a solution of RTKLIB or Emlid, {_BY_TIME}"),
    (r"<blocksexchange", "is BlocksExchange XML (DJI Terra, ContextCapture). Export the positions as text instead."),
    (r"<document\b", "is Metashape's XML. Export the reference as text instead (.txt, .csv), with a line of columns."),
    (r"\A<", "is XML. Export the positions as text instead, with the columns name,lat,lon,alt."),
    (
        r"^[{[]\s*[{\"\]]|^[{[]$",
        "is JSON. Export a table instead: `exiftool -csv -n -GPS* PHOTOGRAPHS`, or ODM's geo.txt.",
    ),
)
#: What each column is called, once blanks, signs, accents, units and the case of letters are taken away.
_COLUMNS: dict[str, frozenset[str]] = {
    what: frozenset(names.split())
    for what, names in {
        "name": "name label image imagename imagefile imagefilename filename file sourcefile photo photoname "
        "photograph picture picturename img imgname path filepath imagepath cameraname photolabel "
        "dateiname bildname bild nombre imagen fichier nomdufichier nomefile 照片名称 文件名 名称",
        "lat": "lat latitude gpslatitude gpslat ylatitude latitudey latitudedeg latdeg wgs84lat wgs84latitude "
        "latitudewgs84 ylat cameralatitude originallatitude breite breitengrad latitud latitudine 纬度",
        "lon": "lon long lng longitude gpslongitude gpslon gpslong gpslng xlongitude longitudex longitudedeg londeg "
        "wgs84lon wgs84longitude longitudewgs84 xlon cameralongitude originallongitude lange langengrad "
        "longitud longitudine 经度",
        "alt": "alt altitude gpsaltitude gpsalt zaltitude altitudez altitudem height ellipsoidheight ellipsoidalheight "
        "heightm heightz ele elev elevation z h up absolutealtitude altm cameraaltitude gpsheight zh altitudemsl "
        "heightellipsoid ellh elevationm altft altitudeft altitudefeet heightft hohe altitud altura quota 高度 海拔",
        "x": "x easting east e utmeasting utmx xeasting xe eastingx coordx xm eastingm xeast rechtswert ostwert este",
        "y": "y northing north n utmnorthing utmy ynorthing yn northingy coordy ym northingm ynorth hochwert "
        "nordwert norte",
        "latref": "latref latituderef gpslatituderef",
        "lonref": "lonref longituderef gpslongituderef",
        "altref": "altref altituderef gpsaltituderef",
        "across": "accuracyhorizontal horizontalaccuracy hacc accuracyh hdev horizontalerror accuracyxy errorxy "
        "gpshpositioningerror accuracyhorz horizontalaccuracym hzaccuracy xyaccuracy",
        "eastwards": "rmseasting eastingrms sde stddeve sigmae accuracyxeasting accuracyxlongitude accuracyx",
        "northwards": "rmsnorthing northingrms sdn stddevn sigman accuracyynorthing accuracyylatitude accuracyy",
        "upwards": "accuracyvertical verticalaccuracy vacc accuracyv vdev verticalerror accuracyz errorz "
        "verticalaccuracym zaccuracy rmselevation elevationrms sdu stddevu sigmau accuracyzaltitude",
        "system": "epsg crs srs epsgcode",
    }.items()
}  # fmt: skip
_DEVIATIONS = ("across", "upwards", "eastwards", "northwards")
_UNIT = re.compile(
    r"[\[(][^\])]*[\])]|[_ ](?:decimal degrees|dd|deg|degrees|m|met(?:er|re)s?|(?:us[ _]?)?f(?:oo|ee)?t)$"
)
#: How the names of columns, and values, say that they are feet.
_FEET = re.compile(r"(?:[\[( _\d]|^alt|^altitude|^height)(us[ _]?(?:survey[ _]?)?)?(?:ft|feet|foot)\b", re.IGNORECASE)
FOOT_M, SURVEY_FOOT_M = 0.3048, 1200 / 3937
#: What programs write where they know nothing.
_UNKNOWN = frozenset({"", "nan", "none", "null", "-", "n/a", "na"})
#: Names of columns of altitudes that others of a table give way to: heights may be those over the ground.
_ALTITUDE = re.compile(r"alt(?!ura)|elli?p|ellh|elev|海拔", re.IGNORECASE)
#: Units of columns: parts of metres, and angles.
_PARTS = re.compile(r"[\[( _](mm|cm|km)\b", re.IGNORECASE)
_ANGLES = re.compile(r"°|[\[( _](?:deg|degrees|rad)\b", re.IGNORECASE)
#: Words of exiftool behind altitudes below the sea.
_BELOW = re.compile(r"below|^1$", re.IGNORECASE)
_LEADING_NUMBER = re.compile(r"\s*([+-]?\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?)\s*(?:m|metres|meters)?\b", re.IGNORECASE)
#: DJI's list of moments (.MRK): one line for each photograph, by its number.
_MRK = re.compile(r"([-\d.]+),Lat\s+([-\d.]+),Lon\s+([-\d.]+),Ellh")
_ENDING = re.compile(r"\.[A-Za-z]{3,4}$")


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


class _Columns(NamedTuple):
    where: dict[str, int]
    """Which word of a row is what."""
    system: str | None
    """The coordinate system that the table names."""
    altitude_unit: float = 1.0
    """Metres in one of its altitudes."""
    assumed: bool = False
    """The order is that of programs that write no header."""
    heights: tuple[str, ...] = ()
    """Names of the columns of altitudes: the one that is read, and those that are not."""
    deviation_units: Mapping[str, float] = MappingProxyType({})
    """Metres in one of each of its accuracies, NaN for angles."""


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
    for line in lines:
        if system is None and not body and names_a_system(_after_colon(line.text)):
            system = _after_colon(line.text)
        else:
            body.append(line)
    body = [line for line in body if not line.text.startswith("#") or _is_header(line)]
    body = [Line(line.number, line.text.lstrip("# ") if k == 0 else line.text) for k, line in enumerate(body)]
    if not body:
        raise CaptureError(f"{file}: is empty. Write a first line `name,lat,lon,alt` and one for each photograph.")
    rows = rows_of(body)
    columns, rows = _columns(rows, system, file)
    if not rows:
        raise CaptureError(f"{file}: names its columns but holds no rows. Write one for each photograph.")
    placed = [row for row in rows if _has_place(row, columns)]
    if not placed:
        raise CaptureError(f"{file}: none of its {len(rows)} rows has a position. Export the table once it has them.")
    place = _projected if columns.system is not None and "x" in columns.where else _geodetic
    positions = place(placed, columns, file)
    found = [
        GpsRow(row.number, row.words[columns.where["name"]], position, _deviations(row, columns))
        for row, position in zip(placed, positions, strict=True)
    ]
    notes = list[str]()
    if columns.assumed:
        notes.append(f"{file.name} names no columns; read as name, latitude, longitude, altitude.")
    if columns.heights:
        read, *others = map(repr, columns.heights)
        notes.append(f"{file.name}: altitudes are those of the column {read}, not of {', '.join(others)}.")
    if len(placed) < len(rows):
        notes.append(f"{file.name}: {len(rows) - len(placed)} of {len(rows)} rows have no position; not used.")
    return GpsTable(tuple(found), notes=tuple(notes))


def _after_colon(text: str) -> str:
    """A line without the sign of a comment and without `CoordinateSystem:` (Metashape) before the system."""
    plain = text.lstrip("# ").strip()
    head, colon, rest = plain.partition(":")
    return rest.strip() if colon and re.fullmatch(r"(?i)coordinate ?system|crs|srs", head.strip()) else plain


def _is_header(line: Line) -> bool:
    """Whether a line that begins like a comment names the columns (Metashape, RealityScan)."""
    words = rows_of([Line(line.number, line.text.lstrip("# "))])[0].words
    return {"name"} < set(known_columns(words))


def known_columns(words: Sequence[str]) -> dict[str, int]:
    """Which of these names of columns is what."""
    found: dict[str, int] = {}
    for k, word in enumerate(words):
        letters = unicodedata.normalize("NFKD", word.lower())  # accents are signs of their own, brackets are narrow
        plain = re.sub(r"[\W_]", "", _UNIT.sub("", letters))
        what = next((what for what, names in _COLUMNS.items() if plain in names), None)
        if what == "alt" and what in found and _ALTITUDE.search(word) and not _ALTITUDE.search(words[found[what]]):
            found[what] = k
        elif what is not None:
            found.setdefault(what, k)
    return found


def _columns(rows: list[Row], system: str | None, file: Path) -> tuple[_Columns, list[Row]]:
    """The columns and the rows below their names. Raises CaptureError."""
    known = known_columns(rows[0].words)
    unit = _meters(rows[0].words[known["alt"]]) if "alt" in known else 1.0
    others = [word for k, word in enumerate(rows[0].words) if "alt" in known_columns([word]) and k != known["alt"]]
    heights = (rows[0].words[known["alt"]], *others) if others else ()
    named = {what: rows[0].words[known[what]] for what in _DEVIATIONS if what in known}
    units = {what: math.nan if _ANGLES.search(word) else _meters(word) for what, word in named.items()}
    if {"name", "lat", "lon"} <= set(known):
        return _Columns(known, None, unit, heights=heights, deviation_units=units), rows[1:]
    if {"lat", "lon"} <= set(known):
        raise CaptureError(f"{file}: has positions but no column of photographs' names: it is {_BY_TIME}")
    if {"name", "x", "y"} <= set(known):
        if system is None and "system" in known and len(rows) > 1:
            code = rows[1].words[known["system"]]
            system = f"EPSG:{code}" if code.isdecimal() else code
        if system is None:
            raise CaptureError(
                f"{file}: has the columns {rows[0].words[known['x']]!r} and {rows[0].words[known['y']]!r} but does not "
                "say of which coordinate system. Write its code as a first line of its own, such as EPSG:32633, or "
                "give name,lat,lon,alt."
            )
        return _Columns(known, system, unit, heights=heights, deviation_units=units), rows[1:]
    if not _has_numbers(rows[0]):
        found = ", ".join(sorted(word for word in rows[0].words if word)) or "nothing"
        marks = "" if system is None else " A list of control points is given as --gcp."
        raise CaptureError(
            f"{file}: needs a first line that names the columns name,lat,lon,alt (found: {found}).{marks}"
        )
    order = {"name": 0, "alt": 3} if len(rows[0].words) > 3 else {"name": 0}
    if system is not None:
        if len(rows[0].words) > 8:  # ODM: name x y z yaw pitch roll and two accuracies
            order |= {"across": 7, "upwards": 8}
        return _Columns({**order, "x": 1, "y": 2}, system), rows
    values = [_plain_number(row.words[k]) for row in rows for k in (1, 2) if len(row.words) > k]
    firsts, seconds = np.abs(np.array(values[::2], float)), np.abs(np.array(values[1::2], float))
    if max(firsts.max(initial=0), seconds.max(initial=0)) > 180:
        raise CaptureError(
            f"{file}: names neither its columns nor the coordinate system of values such as {rows[0].words[1]}, "
            f"{rows[0].words[2]}. Write its code as a first line of its own, such as EPSG:32633."
        )
    swapped = firsts.max(initial=0) > 90
    places = {"lat": 2 if swapped else 1, "lon": 1 if swapped else 2}
    return _Columns({**order, **places}, None, assumed=not swapped), rows


def _meters(word: str) -> float:
    """How many metres the unit has that a word names: feet, US survey feet, parts of metres, or metres."""
    feet = _FEET.search(word)
    if parts := _PARTS.search(word):
        return {"mm": 1e-3, "cm": 1e-2, "km": 1e3}[parts[1].lower()]
    return 1.0 if feet is None else SURVEY_FOOT_M if feet[1] else FOOT_M


def _has_numbers(row: Row) -> bool:
    return len(row.words) > 2 and all(math.isfinite(_plain_number(word)) for word in row.words[1:3])


def _plain_number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def _word(row: Row, columns: _Columns, what: str) -> str:
    k = columns.where.get(what)
    return row.words[k].strip() if k is not None and k < len(row.words) else ""


def _has_place(row: Row, columns: _Columns) -> bool:
    both = ("x", "y") if "x" in columns.where and columns.system is not None else ("lat", "lon")
    return bool(_word(row, columns, "name")) and all(_word(row, columns, what).lower() not in _UNKNOWN for what in both)


def _geodetic(rows: Sequence[Row], columns: _Columns, file: Path) -> list[tuple[float, float, float]]:
    found = []
    for row in rows:
        angles = [
            _angle(row, columns, what, reference, axis)
            for what, reference, axis in (("lat", "latref", "latitude"), ("lon", "lonref", "longitude"))
        ]
        if None in angles:
            words = [_word(row, columns, what) for what in ("lat", "lon", "alt")]
            raise CaptureError(f"{file}: line {row.number}: {words} are not numbers. Mend the row.")
        position = (angles[0] or 0.0, angles[1] or 0.0, _altitude(row, columns, file))
        check_geodetic(position, file, f"line {row.number}: ")
        found.append(position)
    return found


def _angle(row: Row, columns: _Columns, what: str, reference: str, axis: str) -> float | None:
    word = _word(row, columns, what)
    try:
        read: tuple[float, bool] | None = (float(word), False)
    except ValueError:
        read = degrees_of_text(word, axis)
    if read is None:
        return None
    side = degrees_of_text(f"{abs(read[0])} {_word(row, columns, reference)[:1]}", axis)
    return side[0] if side is not None and side[1] else read[0]


def _altitude(row: Row, columns: _Columns, file: Path) -> float:
    word = _word(row, columns, "alt")
    if word.lower() in _UNKNOWN:
        return math.nan
    number = _LEADING_NUMBER.match(word)
    unit = _meters(word)
    if number is None or (word[number.end() :].strip() and "sea" not in word.lower() and unit == 1):
        raise CaptureError(f"{file}: line {row.number}: the altitude {word!r} is not a number. Mend the row.")
    value = float(number[1].replace(",", ".")) * (unit if unit != 1 else columns.altitude_unit)
    below = _BELOW.search(word[number.end() :]) or _BELOW.search(_word(row, columns, "altref"))
    return -abs(value) if below else value


def _projected(rows: Sequence[Row], columns: _Columns, file: Path) -> list[tuple[float, float, float]]:
    change, system = to_geodetic(columns.system or "", file)
    places = []
    for row in rows:
        x, y = (_plain_number(_word(row, columns, what)) for what in ("x", "y"))
        if not (math.isfinite(x) and math.isfinite(y)):
            words = [_word(row, columns, what) for what in ("x", "y", "alt")]
            raise CaptureError(f"{file}: line {row.number}: {words} are not numbers. Mend the row.")
        places.append((x, y, _altitude(row, columns, file)))
    if not places:
        return []
    given = np.array(places)
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
        _plain_number(_word(row, columns, what)) * columns.deviation_units.get(what, 1.0) for what in _DEVIATIONS
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
        spread = [_plain_number(word) for word in re.split(r"[,\s]+", text[match.end() :].strip()) if word][:3]
        known = len(spread) == 3 and all(0 < value < 100 for value in spread)
        deviations = (max(spread[:2]), spread[2]) if known else None
        rows.append(GpsRow(number, words[0], position, deviations))
    without = len(lines) - len(rows)
    notes = (f"{file.name}: {without} of {len(lines)} rows have no position; not used.",) if without else ()
    return GpsTable(tuple(rows), numbered=True, notes=notes)


def with_altitudes(altitudes: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, bool]:
    """Which of the `known` positions [n] bool are used, and whether their altitudes [n] are: the positions with an
    altitude; where most positions have none, all positions, in the plane alone."""
    finite = known & np.isfinite(altitudes)
    enough = finite.sum() >= min(3, known.sum()) and 2 * finite.sum() >= known.sum()
    return (finite, True) if enough else (known, False)


def by_number(names: Sequence[str]) -> Callable[[str], tuple[tuple[int, int], list[int]]]:
    """What finds photographs by the number that DJI gives them: the last group of four digits of their names."""
    found: dict[int, list[int]] = {}
    for index, name in enumerate(names):
        digits = re.findall(r"(?<!\d)\d{4}(?!\d)", _ENDING.sub("", name.rpartition("/")[2]))
        if digits:
            found.setdefault(int(digits[-1]), []).append(index)
    return lambda number: ((0, 0), found.get(int(number), []) if number.isdecimal() else [])


def check_geodetic(position: tuple[float, ...], file: Path, where: str = "") -> None:
    """Raise CaptureError for what is no place on Earth; an altitude may be NaN."""
    latitude, longitude, altitude = position
    high = math.isinf(altitude) or abs(altitude) >= 1e5
    if not (abs(latitude) <= 90 and abs(longitude) <= 360) or high:
        raise CaptureError(
            f"{file}: {where}latitude {latitude}, longitude {longitude}, altitude {altitude} is no place "
            "on Earth. Degrees and metres are expected."
        )
