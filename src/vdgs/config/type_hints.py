"""What the fields of settings hold, by their types."""

from __future__ import annotations

import typing
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any


@cache
def field_hints(kind: type) -> dict[str, Any]:
    """What each field of a config class holds, with its notes: texts of the source, which take long to evaluate."""
    return typing.get_type_hints(kind, include_extras=True)


def without_notes(hint: Any) -> Any:
    """A type without what `Annotated` says beside it."""
    return typing.get_args(hint)[0] if typing.get_origin(hint) is typing.Annotated else hint


def describe_type(hint: Any) -> str:
    """What a value of a type looks like, for people."""
    kind, inner = without_notes(hint), typing.get_args(without_notes(hint))
    origin = typing.get_origin(kind)
    if origin is tuple and inner[-1:] == (Ellipsis,):
        return f"a list, each of it {describe_type(inner[0])}"
    if origin is tuple:
        return f"a list of {len(inner)}: {', '.join(map(describe_type, inner))}"
    if origin in (typing.Union, UnionType):
        return " or ".join(map(describe_type, inner))
    if origin is typing.Literal:
        return " or ".join(map(str, inner))
    named = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}
    return named.get(kind, "null")
