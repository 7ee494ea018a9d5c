"""The lines of a list of surveyed points, ODM's gcp_list.txt, told from what other programs write of them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vdgs.captures.decimal_signs import doubt_of, with_plain_numbers
from vdgs.captures.system_names import defines_a_system, join_definition, names_a_system
from vdgs.captures.table_columns import NO_DATA, UNKNOWN, Row, known_columns, number_of, told_meters
from vdgs.captures.text_tables import LARGEST_ALTITUDE, Line, read_lines, rows_of, separator_of
from vdgs.errors import CaptureError

#: A line of the list, or of names of its columns, has so many words: x, y, z and a mark.
_LEAST_WORDS = 5
#: How large numbers of x, y and z can be.
_LARGEST = {0: math.inf, 1: math.inf, 2: LARGEST_ALTITUDE}
#: How names of photographs end.
_PHOTOGRAPH = re.compile(r"\.(jpe?g|tiff?|png|dng|heic|webp)$", re.I)


@dataclass(frozen=True)
class GcpLine:
    """A mark of a surveyed point: the number of the line, the place in the units of the system, and the pixel."""

    number: int
    place: tuple[float, float, float]
    pixel: tuple[float, float]
    photograph: str
    name: str


def read_rows(file: Path) -> tuple[str, list[Row], tuple[float | None, float | None, float | None]]:
    """The first line, and the words of the others, parted by blanks, or as in a CSV table; without names of columns, of
    which the metres in one of x, y and z are given where they say a unit."""
    lines = _lines_below_system(file)
    if not lines:
        raise CaptureError(f"{file}: is empty. The first line names the coordinate system, such as EPSG:32615.")
    _check_is_list([line.text for line in lines], file)
    text, count = join_definition([line.text for line in lines])
    header, lines = Line(lines[0].number, text), lines[count:]
    rows = [Row(line.number, line.text.split()) for line in lines]
    if separator_of([line.text for line in lines]) is None:
        plain = with_plain_numbers([row.words[:5] for row in rows], _LARGEST, commas_part=False)
        rows = [Row(number, [*front, *words[5:]]) for (number, words), front in zip(rows, plain, strict=True)]
    else:
        parted = rows_of(lines, _LARGEST)
        rows = [row if len(row.words) > 5 else blanks for row, blanks in zip(parted, rows, strict=True)]
    if not rows or any(math.isfinite(number_of(word)) for word in rows[0].words[:5]):  # 489,334.12, too: a mark
        return header.text, rows, (None, None, None)
    _check_order(rows[0], file)
    x, y, z = (rows[0].words + 3 * [""])[:3]
    return header.text, rows[1:], (told_meters(x), told_meters(y), told_meters(z))


def _lines_below_system(file: Path) -> list[Line]:
    """The line that names the coordinate system, and those below it without comments. Where the first line is of the
    list already, the last comment above that defines a system; any other first line is meant to name it."""
    lines = [line._replace(text=line.text.strip()) for line in read_lines(file, "list of control points")]
    body = [line for line in lines if not line.text.startswith("#")]
    if not body or names_a_system(body[0].text) or not _is_of_list(body[0].text):
        return body
    above = [line.text.lstrip("# ") for line in lines if line.number < body[0].number]
    system, k = list[Line](), 0
    while k < len(above):
        text, count = join_definition(above[k:])
        if defines_a_system(text):
            system = [Line(lines[k].number, text)]
        k += count
    return [*system, *body]


def _is_of_list(text: str) -> bool:
    """Whether a line is a mark, or the names of columns, and no name of a system."""
    words = re.split(r"[\s,;]+", text)
    if len(words) < _LEAST_WORDS:
        return False
    is_named = [word[-1:].lower() for word in words[:3]] == ["x", "y", "z"]  # `geo_x geo_y geo_z`, as ODM names them
    known = known_columns(rows_of([Line(1, text)])[0].words)
    return is_named or len(known) > 1 or sum(map(_is_number, words[:5])) > 2


def _check_is_list(lines: Sequence[str], file: Path) -> None:
    """Raise CaptureError for what programs export of control points without, or otherwise with, their marks."""
    kind = _other_format(lines[0].lstrip("\ufeff")) or _half_a_list(lines)
    if kind:
        raise CaptureError(
            f"{file}: is {kind}. --gcp takes ODM's list: a line that names the coordinate system (EPSG:32615), and for "
            "each mark a line `x y z px py photograph name`. Export it so, or put it together from both."
        )


def _other_format(first: str) -> str:
    """What a file is by its beginning, where that is no list of lines with words; empty for a list."""
    if first.startswith("<"):
        return "XML, as Metashape writes markers, or KML or LandXML points"
    if first.startswith(("{", "[")):
        return "JSON"
    if re.match(r"\*?11\d{4}[+-]\w{8}", first):
        return "a measurement file of Leica (GSI), of points without their marks in photographs"
    return ""


def _half_a_list(lines: Sequence[str]) -> str:
    """What a table has, where it is of points without marks or of marks without points; empty for others."""
    words, second = (re.split(r"[\s,;]+", line) for line in (lines[0], lines[min(1, len(lines) - 1)]))
    if _PHOTOGRAPH.search(words[0]) and len(words) > 3 and all(map(_is_number, words[2:4])):
        return "a table of marks without the coordinates of their points"
    if names_a_system(lines[0]):  # WKT names axes as tables name columns
        return ""
    columns = known_columns(re.split(r"[,;\t]", lines[0]))
    named = {"x", "y"} <= set(columns) or {"lat", "lon"} <= set(columns)
    numbered = len(words) > 3 and all(map(_is_number, words[1:4]))
    if (named or numbered) and not (_is_mark(words) or _is_mark(second)):
        return "a table of points without their marks in photographs"
    return ""


def _is_mark(words: Sequence[str]) -> bool:
    """Whether words name a photograph, or are five numbers and a name."""
    row = len(words) > 5 and all(map(_is_number, words[:5])) and not _is_number(words[5])
    return row or any(map(_PHOTOGRAPH.search, words))


def _check_order(names: Row, file: Path) -> None:
    """Raise CaptureError where a line of column names has x, y and z elsewhere than in front."""
    known = known_columns(names.words)
    for place, columns in enumerate((("x", "lon"), ("y", "lat"), ("alt",))):
        if any(known.get(what, place) != place for what in columns):
            raise CaptureError(
                f"{file}: line {names.number}: the columns {', '.join(names.words)[:80]} are in another order than "
                "`x y z px py photograph [name]` (x is east or longitude). Put them into this order."
            )


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _number(word: str) -> float:
    """A number, also with signs between thousands. ValueError for anything else."""
    found = number_of(word)
    return float(word) if math.isnan(found) else found


def _doubt(words: Sequence[str]) -> str:
    """What to say of the first of a row's numbers that may be thousands or decimals; empty where there is none."""
    return next(filter(None, map(doubt_of, words[:5])), "")


def parse_line(row: Row, file: Path, height: float) -> GcpLine:
    """What a line says, its height times `height`."""
    number, words = row
    try:
        flat = words[2].strip().lower() in UNKNOWN or number_of(words[2]) in NO_DATA
        x, y, z, across, down = map(_number, [*words[:2], "0" if flat else words[2], *words[3:5]])
        photograph = words[5].strip()
    except (ValueError, IndexError):
        if doubt := _doubt(words):
            raise CaptureError(f"{file}: line {number}: a number {doubt}") from None
        alone = " Surveyed points alone do not say where photographs show them." if len(words) < 6 else ""
        line = " ".join(words)[:80]
        alone = alone or " (nan for a height that is not known.)"
        raise CaptureError(
            f"{file}: line {number}: {line!r} is not `x y z px py photograph [name]`. Mend the line.{alone}"
        ) from None
    if not all(map(math.isfinite, (x, y, z, across, down))):
        raise CaptureError(f"{file}: line {number}: numbers must be finite. Mend the line.")
    name = words[6].strip() if len(words) > 6 else ""
    place = x, y, math.nan if flat else z * height  # the one NaN: places of it are equal
    return GcpLine(number, place, (across, down), photograph, name)
