"""Whether commas and points in the numbers of a table are before decimals or between thousands: `1,634` may be both."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest

#: A number that may be either: one sign before three digits.
_EITHER = re.compile(r"[+-]?[1-9]\d{0,2}([.,])\d{3}")
_DECIMAL = re.compile(r"[+-]?\d*([.,])\d+")
#: Signs between thousands: of several, or in front of a decimal sign.
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:(?:(,)\d{3})+(?:\.\d+|,\d{3})|(?:(\.)\d{3})+(?:,\d+|\.\d{3}))")
#: Blanks and apostrophes between thousands (French, Swiss): the sign behind them is before decimals.
_SPACED = re.compile(r"[+-]?\d{1,3}(?:[ \u00a0\u202f\u2009'’]\d{3})+([.,])\d+")
#: A number, and a unit behind it as in `1,636 m Above Sea Level`.
_WITH_UNIT = re.compile(r"([+-]?[\d.,]+)((?:\s*(?:m|ft|feet|foot|met(?:er|re)s?)\b[\w ]*)?)", re.IGNORECASE)


@dataclass
class _Shown:
    """Which signs some numbers show before decimals, and which between thousands."""

    decimal: set[str] = field(default_factory=set)
    thousands: set[str] = field(default_factory=set)

    def add(self, word: str, most: float) -> None:
        """Note what a word shows that is no larger than `most`."""
        match = _WITH_UNIT.fullmatch(word)
        number = match[1] if match else ""
        if spaced := _SPACED.fullmatch(word.strip()):
            self.decimal |= {spaced[1]}
        elif grouped := _GROUPED.fullmatch(number):
            sign = grouped[1] or grouped[2]
            self.thousands.add(sign)
            self.decimal.add("." if sign == "," else ",")
        elif (alone := _DECIMAL.fullmatch(number)) and not may_be_thousands(number, most):
            self.decimal |= {alone[1]}

    def is_decimal(self, sign: str, also_points: bool) -> bool | None:
        """Whether a sign is before decimals; None where that is not shown. The other sign before decimals says that a
        comma is between thousands, and of points only if `also_points`."""
        other = "," if sign == "." else "."
        is_other = sign in self.thousands or (other in self.decimal and (sign == "," or also_points))
        return None if (sign in self.decimal) == is_other else not is_other


def may_be_thousands(number: str, most: float = math.inf) -> bool:
    """Whether a number may have a sign between thousands or before decimals, and is at most `most` with the former."""
    return bool(_EITHER.fullmatch(number)) and abs(float(re.sub("[.,]", "", number))) <= most


def with_plain_numbers(rows: Sequence[Sequence[str]], most: Mapping[int, float], commas_part: bool) -> list[list[str]]:
    """The words of a table without signs between thousands and with points before decimals.

    A number such as `1,634` is what others of its column show, else others of the table; where commas part the words
    (`commas_part`) those in numbers are between thousands, unless some are before decimals. It keeps its comma where
    nothing tells what that is. `most` says for columns of lengths and angles how large numbers can be. In these a
    number such as `1.634` gets a comma where others of the table, and none of its column, have commas before decimals:
    it is in doubt then, too.
    """
    columns, table = [_Shown() for _ in range(max(map(len, rows), default=0))], _Shown()
    for k, words in enumerate(zip_longest(*rows, fillvalue="")):
        for word in words:
            columns[k].add(word, most.get(k, math.inf))
            table.add(word, most.get(k, math.inf))
    if commas_part and "," not in table.decimal:
        table.thousands.add(",")
    return [[_plain(word, columns[k], table, most.get(k)) for k, word in enumerate(row)] for row in rows]


def _plain(word: str, column: _Shown, table: _Shown, most: float | None) -> str:
    match = _WITH_UNIT.fullmatch(word)
    if match is None or not (alone := _DECIMAL.fullmatch(match[1])):
        return word
    number, unit, sign = match[1], match[2], alone[1]
    is_decimal: bool | None = True
    if may_be_thousands(number, math.inf if most is None else most):
        by_column = column.is_decimal(sign, also_points=True)
        is_decimal = table.is_decimal(sign, also_points=False) if by_column is None else by_column
    if is_decimal is None:
        in_doubt = most is not None and "," in table.decimal and "." not in table.decimal
        return number.replace(".", ",") + unit if in_doubt else word
    return number.replace(sign, "." if is_decimal else "") + unit


def doubt_of(number: str, most: float = math.inf) -> str:
    """What to say of a number that kept a comma which may be before decimals or between thousands; nothing of others,
    and of those that are more than `most` with thousands."""
    if "," not in number or not may_be_thousands(number, most):
        return ""
    whole, decimal = number.replace(",", ""), number.replace(",", ".")
    return f"may be {whole} or {decimal}, and nothing in the table says which. Write {whole} or {decimal}0."
