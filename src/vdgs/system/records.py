"""Frozen dataclasses as JSON objects and back."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

R = TypeVar("R")


#: A record ready for JSON, every field of it.
record_to_dict = dataclasses.asdict


def record_to_compact_dict(record: Any) -> dict[str, Any]:
    """A record ready for JSON, without the fields that are None."""
    return {name: value for name, value in dataclasses.asdict(record).items() if value is not None}


def record_from_dict(kind: type[R], values: Any) -> R:
    """The inverse of `record_to_dict` and `record_to_compact_dict`. Unknown keys are ignored.

    Raises ValueError, naming the field, for a value of another kind or one that is missing.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{_shortened(values)} is not an object")
    hints = typing.get_type_hints(kind)
    taken = {name: _read(hints[name], values[name], name) for name in hints if name in values}
    try:
        return kind(**taken)
    except TypeError as error:  # it names what is missing
        raise ValueError(str(error)) from error


def _read(hint: Any, value: Any, name: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None and type(None) in arguments:
            return None
        (hint,) = (each for each in arguments if each is not type(None))
        return _read(hint, value, name)
    if origin is tuple:
        if not isinstance(value, list):
            raise ValueError(f"{name} is {_shortened(value)}, not a list")
        return tuple(_read(arguments[0], each, name) for each in value)
    if dataclasses.is_dataclass(hint):
        return record_from_dict(typing.cast(type, hint), value)
    accepted = (int, float) if hint is float else hint
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{name} is {_shortened(value)}")
    try:
        return float(value) if hint is float else value
    except OverflowError as error:  # a number that JSON can hold and no float can
        raise ValueError(f"{name} is {_shortened(value)}") from error


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:40] + "…"
