"""Latitudes and longitudes as people and programs write them: decimal, degrees and minutes, with words for the side."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence

_NUMBER = re.compile(r"\d+(?:[.,]\d+)?(?:[eE][+-]?\d+)?")
#: Degrees, minutes and seconds with points between them, and NMEA's degrees and minutes in one number.
_POINTS, _NMEA = re.compile(r"([+-]?\d{1,3})\.(\d{1,2})\.(\d{1,2}(?:\.\d+)?)"), re.compile(r"(\d{2,3})(\d\d\.\d+)")
#: Words that degrees, minutes and seconds may be written with.
_UNITS = re.compile(r"degrees?|deg|minutes?|min|seconds?|sec", re.IGNORECASE)
#: Sides in Chinese and Japanese.
_SIDES_BY_SIGN = {"北[緯纬]": "N", "南[緯纬]": "S", "[東东][経经經]": "E", "西[経经經]": "W"}
#: Signs of other things than angles.
_OTHER_SIGNS = re.compile(r"[%$€#*@!?=<>/|&~^]")
#: What stands for the sign of degrees where a program lacks it: before minutes.
_LOST_SIGN = re.compile(r"(?<=\d)[?*](?=\s?\d{1,2}(?:[.,]\d+)?\s?['′’])")
#: First letters of the words for south and west, north and east, in the axis that they belong to.
SIDES = {"latitude": ("S", "N"), "longitude": ("W", "E")}
#: The largest value of each, in degrees.
LIMITS = {"latitude": 90.0, "longitude": 180.0}


def side_of(word: str, axis: str) -> float | None:
    """-1 for south or west, 1 for north or east, by the first letter of a word; None for anything else."""
    letter = word.strip().upper()[:1]
    south, north = SIDES[axis]
    return -1.0 if letter == south else 1.0 if letter == north else None


def degrees_of_parts(parts: Sequence[float | None]) -> float | None:
    """Degrees from up to three numbers: degrees, minutes, seconds. Seconds that are none count as 0, and so do minutes
    where the degrees have a fraction: whole degrees alone are no place (up to 111 km off)."""
    if not 1 <= len(parts) <= 3 or parts[0] is None:
        return None
    if len(parts) > 1 and parts[1] is None and parts[0] % 1 == 0:
        return None
    whole, *rest = (0.0 if value is None else value for value in parts)
    if any(not 0 <= value < 60.0001 for value in rest):
        return None
    degrees = sum(value / 60**power for power, value in enumerate((abs(whole), *rest)))
    return math.copysign(degrees, whole)


def degrees_of_text(text: str, axis: str) -> tuple[float, bool] | None:
    """Degrees from text such as `-33.5`, `33.5 S`, `33°30'1.5" South` or `33,30.02S`, and whether it says the side.

    None for what is no such angle, and where a minus sign contradicts the side (`-33.5 N`). A comma stands for the
    decimal point where it is the only one of its text.
    """
    plain = _without_units(text)
    if any(sign.isalpha() and not sign.isascii() for sign in plain):  # of a script that is not read
        return None
    letters = re.findall(r"[A-Za-z]+", re.sub(r"\d[eE][+-]?\d", "00", plain))
    if len(letters) > 1 or _OTHER_SIGNS.search(plain):
        return None
    side = side_of(letters[0], axis) if letters else None
    if letters and side is None:
        return None
    numbers = _parted(re.sub(r"[A-Za-z]+$|^[A-Za-z]+", " ", plain).strip(), side is not None)
    value = _degrees_of_numbers(numbers)
    if value is None:
        return None
    negative = says_minus(numbers)
    if side is not None:
        return (side * value, True) if not (negative and value and side > 0) else None
    return (-value if negative else value), negative


def says_minus(text: str) -> bool:
    """Whether a text begins with a minus sign."""
    return text.lstrip().startswith(("-", "\u2212"))


def _without_units(text: str) -> str:
    """Text without the words and signs of degrees, minutes and seconds that are letters, its side as one of N, S, E, W
    where Chinese or Japanese says it."""
    plain = _UNITS.sub(" ", unicodedata.normalize("NFKC", text.replace("\u00ba", " "))).strip()
    plain = _LOST_SIGN.sub(" ", plain)
    for signs, side_letter in _SIDES_BY_SIGN.items():
        plain = re.sub(signs, side_letter, plain)
    return re.sub("(?<=\\d)[度分秒]", " ", plain)


def _parted(plain: str, has_side: bool) -> str:
    """Text of numbers with blanks between degrees, minutes and seconds that points, commas or nothing parts."""
    # In XMP `33,30.02` has degrees and minutes; in a table `33,5` is decimal.
    if plain.count(",") and ("." in plain or plain.count(",") > 1 or has_side):
        plain = plain.replace(",", " ")
    found = _POINTS.fullmatch(plain) or (_NMEA.fullmatch(plain) if has_side else None)
    return " ".join(found.groups()) if found else plain


def _degrees_of_numbers(text: str) -> float | None:
    """Degrees without their sign from text of up to three numbers; None where it has other points and commas."""
    if re.search(r"[.,]", _NUMBER.sub("", text)):
        return None
    value = degrees_of_parts([float(word.replace(",", ".")) for word in _NUMBER.findall(text)])
    return value if value is not None and math.isfinite(value) else None
