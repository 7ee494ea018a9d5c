"""When photographs were taken, by their EXIF."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path

from vdgs.captures.image_tags import read_tags
from vdgs.errors import CaptureError

_DATE_TAKEN, _DATE = 0x9003, 0x0132
#: EXIF's form: 2026:06:23 16:31:59; some programs write other signs (2026-06-23T16:31:59).
_FORM = re.compile(r"(\d{4})[:/.-](\d\d)[:/.-](\d\d)[ T](\d\d:\d\d)")
#: A date without this is that of a clock that was never set.
_SET = re.compile("[^0\\W]")


def exif_form(moment: str) -> str:
    """A date and time with EXIF's signs, whatever signs a program wrote; other texts as they are; empty for that of a
    clock that was never set (`0000:00:00 00:00:00`)."""
    if not _SET.search(moment):
        return ""
    return _FORM.sub(r"\1:\2:\3 \4", moment, count=1) if _FORM.match(moment) else moment


def time_of(moment: str) -> datetime | None:
    """A date and time of EXIF to the second; None where it is none."""
    try:
        return datetime.strptime(exif_form(moment)[:19], "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None


def first_and_last(moments: Iterable[str]) -> tuple[str, ...]:
    """The first and the last of EXIF's dates and times, as 2026-06-23 16:31; empty where none can be read."""
    found = [f"{m[1]}-{m[2]}-{m[3]} {m[4]}" for each in moments if (m := _FORM.match(each)) and m[1] > "1980"]
    return (min(found), max(found)) if found else ()


def date_taken(file: Path) -> str:
    """The date and time in the EXIF of a photograph; empty where EXIF lacks them or cannot be read."""
    try:
        found = read_tags(file)
        value = found.details.get(_DATE_TAKEN) or found.tags.get(_DATE) or ""
    except (CaptureError, OSError, ValueError, SyntaxError, KeyError, TypeError, AttributeError, struct.error):
        return ""  # what Pillow raises for damaged EXIF
    return value if isinstance(value, str) else ""
