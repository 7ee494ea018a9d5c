"""Settings as plain dictionaries and back, for YAML and JSON, and what differs between two of them."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any

from vdgs.config.number_words import how_to_write, plain_number
from vdgs.config.ranges import to_flag
from vdgs.config.type_hints import describe_type, field_hints, without_notes
from vdgs.config.typed_paths import expand_home


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain dictionaries and lists, ready for YAML or JSON."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        if isinstance(value, (str, int, float, bool)) or value is None:
            return value
        return str(value)

    return plain(dataclasses.asdict(config))


def diff_settings(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[str]:
    """Lines that say which settings differ, e.g. `growth.threshold: 0.0002 -> 0.0004`."""
    lines = []
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            lines += diff_settings(before, after, f"{prefix}{key}.")
        elif before != after:
            lines.append(f"{prefix}{key}: {before} -> {after}")
    return lines


def from_dict(kind: type, values: Mapping[str, Any], where: str = "settings", *, numeric_text: bool = True) -> Any:
    """The inverse of `to_dict` for a config class: what is not named keeps its default.

    Raises ValueError, naming the setting, for one that the class does not have or of another kind. `where` is the group
    that it all stands in; `numeric_text` says whether a text may stand for a number, as in files.
    """
    hints = field_hints(kind)
    _check_names(values, kind, where)
    inside = {name: f"{where}.{name}".lstrip(".") for name in values}
    read = _read_words if numeric_text else partial(read_value, numeric_text=False)
    return kind(**{name: read(hints[name], value, inside[name]) for name, value in values.items()})


def flat_values(kind: type, values: Any, where: str, also: Iterable[str] = ()) -> dict[tuple[str, ...], Any]:
    """The values of some settings of a config class, as people write them, by the names of the fields down to them.

    A group with nothing in it, which YAML reads as None, sets nothing. Raises what `from_dict` raises. `also` are
    further names that are there.
    """
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} is {values!r}, not a group of settings")
    hints, flat = field_hints(kind), dict[tuple[str, ...], Any]()
    _check_names(values, kind, where, also)
    for name, value in values.items():
        inner, inside = without_notes(hints[name]), f"{where}.{name}".lstrip(".")
        if dataclasses.is_dataclass(inner):
            within = flat_values(typing.cast(type, inner), value, inside)
            flat |= {(name, *path): each for path, each in within.items()}
        else:
            typed = expand_home(value, hints[name]) if isinstance(value, str) else value
            flat[(name,)] = _read_words(hints[name], typed, inside)
    return flat


def _check_names(values: Mapping[str, Any], kind: type, where: str, also: Iterable[str] = ()) -> None:
    known = [*field_hints(kind), *also]
    unknown = sorted(values.keys() - set(known), key=str)
    if unknown:
        what = f"{where} has no" if where else "there is no setting"
        meant = _in_groups(kind, str(unknown[0])) or suggest(str(unknown[0]), known)
        raise ValueError(f"{what} {unknown[0]!r}{meant}")


def _in_groups(kind: type, name: str) -> str:
    """`; it stands in training` of a setting that the groups of a config class have, and not the class."""
    hints = {group: without_notes(hint) for group, hint in field_hints(kind).items()}
    groups = [group for group, hint in hints.items() if dataclasses.is_dataclass(hint) and name in field_hints(hint)]  # type: ignore[arg-type]
    return f"; it stands in {' and in '.join(groups)}" if groups else ""


def suggest(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'threshold'?` where a known word is like this one."""
    like = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean {like[0]!r}?" if like else ""


def _read_words(hint: Any, value: Any, where: str) -> Any:
    """A plain value, of which texts are numbers as the command line reads them. Raises ValueError."""
    flag, said = to_flag((where,)), value
    if isinstance(value, str):
        value = plain_number(value, flag, hint)
    elif isinstance(value, list):
        value = [plain_number(each, flag, hint) if isinstance(each, str) else each for each in value]
    try:
        return read_value(hint, value, where)
    except ValueError as error:
        how = how_to_write(said, flag, hint) if isinstance(said, str) else ""
        raise ValueError(f"{error}{how}") from None


def read_value(hint: Any, value: Any, where: str, numeric_text: bool = True) -> Any:
    """A plain value as what its type says. Raises ValueError for one that is of no such type."""
    kind = without_notes(hint)
    if getattr(value, "shape", None) == ():  # a number of numpy or torch
        value = value.item()
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise ValueError(f"{where} is {value!r}, not a group of settings")
        return from_dict(typing.cast(type, kind), value, where, numeric_text=numeric_text)
    try:
        if typing.get_origin(kind) is None:
            return _read_plain(kind, value, numeric_text)
        return _read_parts(kind, value, partial(read_value, where=where, numeric_text=numeric_text))
    except _OtherType:
        raise ValueError(f"{where} is {value!r}; it must be {describe_type(hint)}") from None


class _OtherType(Exception):
    """A value is of none of the types that it may be of."""


def _read_parts(kind: Any, value: Any, read: Callable[[Any, Any], Any]) -> Any:
    """A value of a tuple, of one of several types or words; `read` reads one of a type inside."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(value, (list, tuple)):
        kinds = [inner[0]] * len(value) if inner[-1:] == (Ellipsis,) else inner
        if len(kinds) == len(value):
            return tuple(read(each, item) for each, item in zip(kinds, value, strict=True))
    if origin in (typing.Union, UnionType):
        for each in inner:
            with suppress(ValueError):
                return read(each, value)
    if origin is typing.Literal:
        word = ("off", "on")[value] if isinstance(value, bool) else value  # which YAML makes of these words
        if word in inner:
            return word
    raise _OtherType


def _read_plain(kind: Any, value: Any, numeric_text: bool) -> Any:
    if kind is Path and isinstance(value, (str, Path)):
        return Path(value)
    if kind is float and isinstance(value, str) and numeric_text:  # YAML takes 1e-4 for text: it wants 1.0e-4
        with suppress(ValueError):
            return float(value)
    if kind is int and isinstance(value, (str, float) if numeric_text else float):
        with suppress(ValueError):
            return int(value) if isinstance(value, str) else _whole(value)
    plain = isinstance(kind, type) and isinstance(value, (int, float) if kind is float else kind)
    if plain and (kind is bool or not isinstance(value, bool)):
        return value
    raise _OtherType


def _whole(number: float) -> int:
    """A number without decimals. ValueError for others."""
    if not number.is_integer():
        raise ValueError
    return int(number)
