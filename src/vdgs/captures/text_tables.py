"""Text tables as programs write them: any encoding, separator and decimal sign, with or without a header."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from vdgs.errors import CaptureError

#: Larger files are no tables of photographs (bytes).
LONGEST_FILE = 1 << 26
# A track without line ends is one word: it is to be called a track, not to end in csv.Error.
csv.field_size_limit(LONGEST_FILE)
_SEPARATORS = ("\t", ";", ",", "|")
#: Excel's line that says what parts words.
_EXCEL = re.compile(r"\"?sep=.?\"?", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
#: A photograph's name in front of a line whose words are parted by blanks, which may be in the name too.
_NAME_WITH_BLANKS = re.compile(
    r"\s*([^\"#][^\"]*?\.(?:jpe?g|png|tiff?|webp|avif|dng|cr[23]|nef|arw|raf|orf|rw2|hei[cf]|hif))\s+(?=\S)",
    re.IGNORECASE,
)
#: Lines that are looked at for the separator.
LOOKED_AT = 20


class Line(NamedTuple):
    """A line that is not empty, and its number in the file."""

    number: int
    text: str


class Row(NamedTuple):
    """The words of a line."""

    number: int
    words: list[str]


def read_lines(file: Path, what: str = "table of photographs") -> list[Line]:
    """The lines of a text file that are not empty, in UTF-8, UTF-16 or Windows' Latin. Raises CaptureError, which says
    `what` is expected."""
    try:
        if file.stat().st_size > LONGEST_FILE:
            raise CaptureError(f"{file}: is far too large for a {what}.")
        data = file.read_bytes()
    except OSError as error:
        raise CaptureError(f"{file}: cannot be read ({error.strerror}).") from error
    text = decode_text(data)
    if "\x00" in text:
        raise CaptureError(f"{file}: is not a text file. A {what} is expected; save a spreadsheet as CSV.")
    lines = [Line(k, line.strip(" \r")) for k, line in enumerate(text.splitlines(), 1) if line.strip()]
    return lines[1:] if lines and _EXCEL.fullmatch(lines[0].text) else lines


def decode_text(data: bytes) -> str:
    """A text in UTF-8, UTF-16 or Windows' Latin, as programs on Windows write it."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    head = data[:400]
    if head and head[1::2].count(0) > len(head) // 4:
        return data.decode("utf-16-le", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def rows_of(lines: Sequence[Line]) -> list[Row]:
    """The lines as words, without quotes; decimal commas are points where the separator is another."""
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
        words = [word.strip().strip('"') for word in words]
        if separator != ",":
            words = [word.replace(",", ".") if _DECIMAL_COMMA.fullmatch(word) else word for word in words]
        rows.append(Row(line.number, words))
    return rows


def separator_of(lines: Sequence[str]) -> str | None:
    """What parts the words of most lines into three or more; None for blanks."""
    for separator in _SEPARATORS:
        if sum(line.count(separator) >= 2 for line in lines) * 2 > len(lines):
            return separator
    return None
