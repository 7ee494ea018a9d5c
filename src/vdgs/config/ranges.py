"""Which numbers a setting may have, written beside it and checked before any work.

    iterations: Annotated[int, Range(0, MANY)] = 100_000

The range holds for every number in the value: both of a pair, none of None or `auto`. What is no finite number is in no
range. A test walks all settings and all options and fails where a number has none.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from types import UnionType
from typing import Any

from vdgs.config.type_hints import field_hints
from vdgs.errors import VdgsError

#: More than anything that is counted: iterations, anchors, photographs.
MAX_COUNT = 1_000_000_000
#: Weights, factors and the like: beyond it float32 has no room left to compute with them.
MAX_FLOAT = 1_000_000


@dataclass(frozen=True)
class Range:
    """From `least` to `most`, both among them unless said otherwise."""

    min: float
    max: float
    exclusive_min: bool = False
    """The least itself is not possible."""
    exclusive_max: bool = False
    """Nor is the most."""
    allow_zero: bool = False
    """0 is possible too, and means something else."""

    def contains(self, value: float) -> bool:
        """Whether a number lies in the range; no NaN and no infinity does."""
        if self.allow_zero and value == 0:
            return True
        low = self.min < value if self.exclusive_min else self.min <= value
        high = value < self.max if self.exclusive_max else value <= self.max
        return low and high

    def __str__(self) -> str:
        low = f"{'above' if self.exclusive_min else 'at least'} {_plain(self.min)}"
        high = f"{'below' if self.exclusive_max else 'at most'} {_plain(self.max)}"
        return f"{'0, or ' if self.allow_zero else ''}{low} and {high}"


@dataclass(frozen=True)
class FlagName:
    """What a group of settings is called on the command line, where that is not the name of its field."""

    name: str


@dataclass(frozen=True)
class Positional:
    """Marks a field that is an argument without a name on the command line; `name` stands for it in help."""

    name: str = ""
    is_run: bool = False
    """It is the folder of a run, which holds config.yaml."""


class Repeatable:
    """Marks a field whose option may be given several times, each for one more value."""


FRACTION = Range(0, 1)
#: Numbers of threads, processes and the like; 0 leaves the choice to the program.
WORKER_COUNT = Range(0, 1024)


@dataclass(frozen=True)
class NumericSetting:
    """One number of a group of settings: where it stands, what it is and may be."""

    #: Names of the fields down to it, by which the command line and config.yaml know it.
    path: tuple[str, ...]
    value: int | float | None
    range: Range | None

    @property
    def flag(self) -> str:
        """`--block.densify.max-anchors`."""
        return to_flag(self.path)


def to_flag(path: tuple[str, ...]) -> str:
    """What the command line calls the setting at a path."""
    return "--" + ".".join(path).replace("_", "-")


def find_range_errors(settings: Any) -> list[str]:
    """One sentence for every number outside its range; empty if there is none."""
    return [f"{each.flag} {each.value}: must be {each.range}" for each in iter_out_of_range(settings)]


def check_ranges(settings: Any) -> None:
    """Raise VdgsError, naming each option, what it is and what it may be, unless every number is in its range."""
    found = find_range_errors(settings)
    if found:
        raise VdgsError(found[0] if len(found) == 1 else "\n  ".join(["These do not work:", *found]))


def range_missed(hint: Any, value: Any) -> Range | None:
    """The range that a number in a value of some type is outside of; None where all are in theirs."""
    for number, bounds in _ranged(hint, value, None):
        if number is not None and bounds is not None and not bounds.contains(number):
            return bounds
    return None


def iter_out_of_range(settings: Any, within: tuple[str, ...] = ()) -> Iterator[NumericSetting]:
    """Every number that is outside its range."""
    for each in iter_numbers(settings, within):
        if each.value is not None and each.range is not None and not each.range.contains(each.value):
            yield each


def iter_numbers(settings: Any, within: tuple[str, ...] = ()) -> Iterator[NumericSetting]:
    """Every number of a dataclass and of those in it. Where a field may hold one but does not, its value is None."""
    kind: type = type(settings)
    hints = field_hints(kind)
    for field in dataclasses.fields(settings):
        value, hint = getattr(settings, field.name), hints[field.name]
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            names = [each.name for each in typing.get_args(hint)[1:] if isinstance(each, FlagName)]
            inner = names[0] if names else field.name
            yield from iter_numbers(value, (*within, inner) if inner else within)
        else:
            for number, bounds in _ranged(hint, value, None):
                yield NumericSetting((*within, field.name), number, bounds)


def _ranged(hint: Any, value: Any, bounds: Range | None) -> Iterator[tuple[int | float | None, Range | None]]:
    """The numbers in a value of some type, each with the range that is nearest around it in the type."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        own = next((each for each in inner[1:] if isinstance(each, Range)), bounds)
        yield from _ranged(inner[0], value, own)
    elif origin is tuple and isinstance(value, (tuple, list)):
        kinds = [inner[0]] * len(value) if inner[-1:] == (Ellipsis,) else inner
        for kind, each in zip(kinds, value, strict=False):
            yield from _ranged(kind, each, bounds)
    elif origin in (typing.Union, UnionType):
        fitting = [each for each in inner if not _is_number(value) or _holds_numbers(each)]
        yield from _ranged(fitting[0], value, bounds) if fitting else ()
    elif hint in (int, float):
        yield (value if _is_number(value) else None), bounds


def _holds_numbers(hint: Any) -> bool:
    return any(each in (int, float) for each in (hint, *typing.get_args(hint)))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _plain(number: float) -> str:
    return f"{number:g}" if math.log10(max(abs(number), 1)) < 6 else f"{number:,.0f}".replace(",", " ")
