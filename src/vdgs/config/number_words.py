"""Numbers as people write them: 30k, 1e3, 30,000, 1,5, 50 %, 5cm; those that could mean two things are left alone."""

from __future__ import annotations

import re
import typing
from typing import Any

from vdgs.config.ranges import Range
from vdgs.config.type_hints import without_notes

_NUMBER = r"[+-]?(?:\d[\d_]*\.?\d*|\.\d+)(?:e[+-]?\d+)?"
_WITH_UNIT = re.compile(rf"({_NUMBER})\s*([a-zµ%°]+)", re.IGNORECASE)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:[, ']\d{3})+")
_DECIMAL_COMMA = re.compile(r"([+-]?\d+),(\d+)")
#: Units by the end of the name of an option, in the one that the option counts in.
_UNITS = {
    "m": {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0},
    "seconds": {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0},
    "gb": {"gb": 1.0, "gib": 1.0, "g": 1.0, "mb": 1e-3, "tb": 1000.0},
    "mb": {"mb": 1.0, "mib": 1.0, "m": 1.0, "kb": 1e-3, "gb": 1000.0},
    "px": {"px": 1.0},
}
_THOUSAND = {"k": 1e3, "m": 1e6}


def kinds_of(hint: Any) -> set[Any]:
    """The types of the values in a value of some type."""
    inner = [each for each in typing.get_args(without_notes(hint)) if each is not Ellipsis]
    if typing.get_origin(without_notes(hint)) is typing.Literal or not inner:
        return {without_notes(hint)}
    return set().union(*map(kinds_of, inner))


def _is_share(hint: Any) -> bool:
    """Whether a number of some type is at most 1."""
    notes = typing.get_args(hint)[1:] if typing.get_origin(hint) is typing.Annotated else ()
    return any(isinstance(note, Range) and note.max <= 1 for note in notes)


def plain_number(word: str, flag: str, hint: Any) -> str:
    """The number that a word says of an option, as Python reads it; the word itself where it says none or several."""
    kinds = kinds_of(hint)
    if not kinds & {int, float}:
        return word
    whole = float not in kinds
    word = word.replace("\u2212", "-")
    plain, factor = _parted(_without_separators(word, whole), flag, hint, whole)
    if re.fullmatch(_NUMBER, plain, re.IGNORECASE) is None or (not whole and factor == 1 and plain == word):
        return plain
    if factor == 1 and re.fullmatch(r"[+-]?[\d_]+", plain):
        return plain  # with all its digits
    value = float(plain) * factor
    if not whole:
        return repr(float(f"{value:.15g}"))
    decimals = re.fullmatch(r"[+-]?\d+\.\d{3}", plain) is not None  # 30.000 is thirty thousand to many
    return str(int(value)) if value.is_integer() and not decimals and abs(value) < 2**63 else word


def _without_separators(word: str, whole: bool) -> str:
    """A number without signs between thousands, where it is `whole`, and else with a point for a decimal comma."""
    if whole:
        return re.sub(r"[, ']", "", word) if _THOUSANDS.fullmatch(word) else word
    comma = _DECIMAL_COMMA.fullmatch(word)
    if comma and (len(comma[2]) != 3 or comma[1].strip("+-") == "0"):
        return f"{comma[1]}.{comma[2]}"
    return word


def _parted(word: str, flag: str, hint: Any, whole: bool) -> tuple[str, float]:
    """A number without its unit, and the factor to what the option counts in; all of a word whose unit is none of an
    option's, which is no number."""
    found = _WITH_UNIT.fullmatch(word)
    if not found:
        return word, 1.0
    factors = _UNITS.get(re.split(r"[.-]", flag)[-1], _THOUSAND if whole else {})
    factors = {**factors, "%": 0.01} if _is_share(hint) else factors
    unit = found[2].lower()
    return (found[1], factors[unit]) if unit in factors else (word, 1.0)


def how_to_write(words: str, flag: str, hint: Any) -> str:
    """What to say of words that are no number of some type, but hold one; empty for others."""
    kinds = kinds_of(hint)
    if not re.search(r"\d", words) or not kinds & {int, float}:
        return ""
    units = {"m": "metres", "gsd": "units of the map, mostly metres", "seconds": "seconds", "gb": "GB", "mb": "MB"}
    unit = units.get(re.split(r"[.-]", flag)[-1])
    how = "such as 0.25 or 1e-3" if float in kinds else "such as 30000, 30k or 3e4"
    kinds_in = (hint, *typing.get_args(without_notes(hint)))
    apart = ", parted by blanks" if any(typing.get_origin(without_notes(each)) is tuple for each in kinds_in) else ""
    return f"; write {how}{f', in {unit}' if unit else ''}{apart}"
