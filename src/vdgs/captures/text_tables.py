"""Text tables as programs write them: any encoding, separator and decimal sign, with or without a header."""

from __future__ import annotations

import codecs
import csv
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vdgs.captures.decimal_signs import with_plain_numbers
from vdgs.captures.table_columns import Row, known_columns
from vdgs.errors import CaptureError

#: Larger files are no tables of photographs (bytes).
LONGEST_FILE = 1 << 26
# A track without line ends is one word: it is to be called a track, not to end in csv.Error.
csv.field_size_limit(LONGEST_FILE)
_SEPARATORS = ("\t", ";", ",", "|")
#: Excel's line that says what parts words.
_EXCEL = re.compile(r"\"?sep=.?\"?", re.IGNORECASE)
#: Numbers with commas, before decimals or between thousands.
_COMMAS_IN_NUMBER = re.compile(r"[+-]?(?:\d+,\d+|\d{1,3}(?:,\d{3})+(?:\.\d+)?)")
#: No angle in degrees is larger, nor an altitude or an accuracy of photographs, in metres or feet (choice).
LARGEST_ALTITUDE = 20_000.0
_LARGEST = {
    **dict.fromkeys(("lat", "lon"), 360.0), "alt": LARGEST_ALTITUDE,
    **dict.fromkeys(("across", "upwards", "eastwards", "northwards"), 1000.0),
}  # fmt: skip
_MEASURED = {*_LARGEST, "x", "y"}
_NO_NUMBER = re.compile(r"[+-]?(?:nan|inf)\(.*\)|[+-]?1\.#\w+", re.IGNORECASE)
#: A photograph's name in front of a line whose words are parted by blanks, which may be in the name too.
_NAME_WITH_BLANKS = re.compile(
    r"\s*([^\"#][^\"]*?\.(?:jpe?g|png|tiff?|webp|avif|dng|cr[23]|nef|arw|raf|orf|rw2|hei[cf]|hif))\s+(?=\S)",
    re.IGNORECASE,
)
#: A point in WKT (OGC's simple features), with z and m or without.
_WKT_POINT = re.compile(
    r"\s*(?:SRID=\d+;)?POINT\s*(Z?M?)\s*\(\s*([-+.\deE]+)\s+([-+.\deE]+)(?:\s+([-+.\deE]+))?(?:\s+[-+.\deE]+)?\s*\)\s*",
    re.IGNORECASE,
)
_POINT_BEGINS = re.compile(r"(?:SRID=\d+;)?POINT\s*Z?M?\s*\(", re.IGNORECASE)
#: Lines that are looked at for the separator.
LOOKED_AT = 20


class Line(NamedTuple):
    """A line that is not empty, and its number in the file."""

    number: int
    text: str


def read_lines(file: Path, what: str = "table of photographs") -> list[Line]:
    """The lines of a text file that are not empty, in UTF-8, UTF-16, Windows' Latin, or GBK where that makes names of
    columns known. Raises CaptureError, which says `what` is expected."""
    try:
        if file.stat().st_size > LONGEST_FILE:
            raise CaptureError(f"{file}: is far too large for a {what}.")
        data = file.read_bytes()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror}).") from error
    text = _decode_table(data)
    if "\x00" in text:
        raise CaptureError(f"{file}: is not a text file. A {what} is expected; save a spreadsheet as CSV.")
    lines = _lines(text)
    return lines[1:] if lines and _EXCEL.fullmatch(lines[0].text) else lines


def _lines(text: str) -> list[Line]:
    return [Line(k, line.strip(" \r")) for k, line in enumerate(text.splitlines(), 1) if line.strip()]


def _decode_table(data: bytes) -> str:
    """A text as by `decode_text`, but as Excel writes it in China where more names of columns are known then."""
    text = _decode_unicode(data)
    if text is not None:
        return text
    latin = decode_text(data)
    with suppress(UnicodeDecodeError):
        return max(latin, data.decode("gb18030"), key=_known_names)  # the former where they are equal
    return latin


def _known_names(text: str) -> int:
    """How many names of columns are known in the line that has most of them, of the first ones."""
    head = _lines("\n".join(text.splitlines()[:LOOKED_AT]))
    return max((len(known_columns(row.words)) for row in rows_of(head)), default=0)


def read_text(file: Path) -> str:
    """All of a file as by `decode_text`. Raises CaptureError where it cannot be read."""
    try:
        return decode_text(file.read_bytes())
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror or error}).") from error


def read_head(file: Path, num_bytes: int) -> str:
    """The first bytes of a file as by `decode_text`; empty where it cannot be read."""
    try:
        with file.open("rb") as stream:
            return decode_text(stream.read(num_bytes))
    except OSError:
        return ""


def decode_text(data: bytes) -> str:
    """A text in UTF-8, UTF-16 or Windows' Latin, as programs on Windows write it."""
    text = _decode_unicode(data)
    return data.decode("cp1252", errors="replace") if text is None else text


def float_or_nan(word: str) -> float:
    """A number, NaN also as programs write it on Windows: `-nan(ind)`, `-1.#IND`. ValueError for anything else."""
    return math.nan if _NO_NUMBER.fullmatch(word) else float(word)


def parse_numbers(words: Sequence[str]) -> np.ndarray:
    """Numbers [n] float64, each as by `float_or_nan`. ValueError where one is none."""
    try:
        return np.array(words, np.float64)
    except ValueError:
        return np.array([*map(float_or_nan, words)])


def _decode_unicode(data: bytes) -> str | None:
    """A text in UTF-8 or UTF-16; None where it is in neither."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    head = data[:400]
    if head and head[1::2].count(0) > len(head) // 4:
        return data.decode("utf-16-le", errors="replace")
    with suppress(UnicodeDecodeError):
        return data.decode("utf-8-sig")
    return None


def rows_of(lines: Sequence[Line], largest: Mapping[int, float] | None = None) -> list[Row]:
    """The lines as words, without quotes; numbers have points before decimals and no signs between thousands, as far as
    others of the table tell what their signs are. `largest` says for columns of lengths and angles how large numbers
    can be, if not names of columns in the first line."""
    separator = separator_of([line.text for line in lines[:LOOKED_AT]])
    rows = []
    for line in lines:
        if separator is None:
            named = _NAME_WITH_BLANKS.match(line.text)
            rest = " ".join((line.text[named.end() :] if named else line.text).split())
            words = [named[1]] if named else []
            words += next(csv.reader([rest], delimiter=" ", skipinitialspace=True))
        else:
            words = next(csv.reader([line.text], delimiter=separator, skipinitialspace=True))
        rows.append(Row(line.number, [word.strip().strip('"') for word in words]))
    if not rows:
        return rows
    most = _largest_numbers(rows[0].words) or largest or {}
    plain = with_plain_numbers([row.words for row in rows], most, separator == ",")
    return [Row(row.number, words) for row, words in zip(rows, plain, strict=True)]


def _largest_numbers(words: Sequence[str]) -> dict[int, float]:
    """How large numbers can be below these names of columns, as far as they are angles or lengths."""
    return {k: _LARGEST.get(what, math.inf) for what, k in known_columns(words).items() if what in _MEASURED}


def separator_of(lines: Sequence[str]) -> str | None:
    """What parts the words of most lines into three or more, a point in WKT for two; None for blanks."""
    for separator in _SEPARATORS:
        parted = (_POINT_BEGINS.subn("", line) for line in lines)
        counts = (line.count(separator) + points for line, points in parted)
        if sum(count >= 2 for count in counts) * 2 > len(lines):
            return None if separator == "," and _has_commas_in_numbers_only(lines) else separator
    return None


def _has_commas_in_numbers_only(lines: Sequence[str]) -> bool:
    """Whether blanks part each line that has commas into three words or more, and commas stand in numbers alone."""
    parted = [line.split() for line in lines if "," in line]
    return all(
        len(words) > 2 and all(_COMMAS_IN_NUMBER.fullmatch(word) for word in words if "," in word) for words in parted
    )


def with_points_parted(rows: Sequence[Row]) -> list[Row]:
    """Rows below one of headings whose column of points in WKT (`POINT (8.5 47.1)`, `POINT Z (8.5 47.1 500)`, as QGIS
    writes geometries) is parted into columns X and Y, and Z where points have one and no other column is an altitude;
    others stay."""
    if len(rows) < 2:
        return list(rows)
    head = rows[0].words
    for k in range(len(head)):
        points = [_WKT_POINT.fullmatch(row.words[k]) if k < len(row.words) else None for row in rows[1:]]
        if not all(points):
            continue
        found = [point.groups() for point in points if point is not None]
        others = known_columns([*head[:k], *head[k + 1 :]])
        has_z = "alt" not in others and any(z is not None and kind.upper() != "M" for kind, _, _, z in found)
        parted = [["X", "Y", "Z"], *([x, y, (z or "") if kind.upper() != "M" else ""] for kind, x, y, z in found)]
        count = 3 if has_z else 2
        return [
            Row(row.number, [*row.words[:k], *words[:count], *row.words[k + 1 :]])
            for row, words in zip(rows, parted, strict=True)
        ]
    return list(rows)
