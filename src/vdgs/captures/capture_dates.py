"""When photographs were taken, by their EXIF."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from pathlib import Path

from PIL import Image

from vdgs.captures.image_files import pillow_without_limits

_EXIF_IFD, _DATE_TAKEN, _DATE = 0x8769, 0x9003, 0x0132
#: EXIF's form: 2026:06:23 16:31:59; some write hyphens.
_FORM = re.compile(r"(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d:\d\d)")


def first_and_last(moments: Iterable[str]) -> tuple[str, ...]:
    """Of dates and times as EXIF has them the first and the last, as 2026-06-23 16:31; empty where none is one."""
    found = [f"{m[1]}-{m[2]}-{m[3]} {m[4]}" for each in moments if (m := _FORM.match(each)) and m[1] > "1980"]
    return (min(found), max(found)) if found else ()


def date_taken(file: Path) -> str:
    """Date and time as the EXIF of a photograph has them; empty where it has none or cannot be read."""
    try:
        with pillow_without_limits(), Image.open(file) as image:
            tags = image.getexif()
            value = tags.get_ifd(_EXIF_IFD).get(_DATE_TAKEN) or tags.get(_DATE) or ""
    except (OSError, ValueError, SyntaxError, KeyError, TypeError, AttributeError, struct.error):
        return ""  # what Pillow raises for damaged EXIF
    return value if isinstance(value, str) else ""
