"""The run-time type checker of the tests: jaxtyping's shapes by beartype, for which an int is also a float (PEP 484).

`jaxtyping.jaxtyped` binds the arguments of every call and checks them apart from the result; `jaxtyped` here checks the
same in one step, in half the time. What jaxtyping asks of an array, it asks here only where the answer is not known:
one of that kind had fit before, and its sizes do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from inspect import isgeneratorfunction
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping._storage import get_shape_memo, pop_shape_memo, push_shape_memo

_CONFIGURATION = BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError)
_OF_JAXTYPING = jaxtyping.jaxtyped
_ARRAY: Any = type(jaxtyping.AbstractArray)
_FITS_BY_JAXTYPING = _ARRAY.__instancecheck__
#: Of a hint, and of arrays of a type and a dtype that fit it: its sizes, each a number, a name, or None for any.
_SIZES: dict[tuple[Any, type, Any], tuple[int | str | None, ...]] = {}


def _fits(hint: Any, value: Any) -> bool:
    """`isinstance(value, hint)` of jaxtyping's hints."""
    key = hint, type(value), getattr(value, "dtype", None)
    expected = _SIZES.get(key)
    if expected is None:
        fits: bool = _FITS_BY_JAXTYPING(hint, value)
        words = hint.dim_str.split()
        if fits and all(word.isdecimal() or word.isidentifier() for word in words):
            _SIZES[key] = tuple(int(w) if w.isdecimal() else None if w.startswith("_") else w for w in words)
        return fits
    shape, known, found = value.shape, get_shape_memo()[0], dict[str, int]()
    if len(shape) != len(expected):
        return bool(_FITS_BY_JAXTYPING(hint, value))
    for size, wanted in zip(shape, expected, strict=True):
        if isinstance(wanted, str):
            wanted = known[wanted] if wanted in known else found.setdefault(wanted, size)
        if wanted is not None and wanted != size:
            return bool(_FITS_BY_JAXTYPING(hint, value))
    known.update(found)
    return True


_ARRAY.__instancecheck__ = _fits


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function whose types are checked at each call. The checks are generated at the first, for a worker calls few of
    the functions that it imports."""
    made: list[Callable[..., Any]] = []

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        if not made:
            names = getattr(function, "__globals__", {})
            function.__annotations__ = {key: _resolved(hint, names) for key, hint in function.__annotations__.items()}
            made.append(beartype(function, conf=_CONFIGURATION))
        push_shape_memo({})  # while a call lasts, a name of a size means one number
        try:
            return made[0](*arguments, **named)
        finally:
            pop_shape_memo()

    return call


def jaxtyped(decorated: Any = None, *, typechecker: Callable[[Any], Any]) -> Any:
    """A function, or a dataclass, whose types and shapes are checked at each call."""
    if decorated is None:
        return partial(jaxtyped, typechecker=typechecker)
    if isinstance(decorated, type):
        if is_dataclass(decorated) and not hasattr(decorated.__init__, "__wrapped__"):
            decorated.__init__ = typechecker(decorated.__init__)  # type: ignore[misc]
        return decorated
    if isgeneratorfunction(decorated):  # its body runs after its call
        return _OF_JAXTYPING(decorated, typechecker=beartype(conf=_CONFIGURATION))
    return typechecker(decorated)


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """A hint that may be written as a string; anything where it names what only type checkers import."""

    def holder() -> None:
        pass

    holder.__annotations__ = {"hint": hint}
    try:
        return get_type_hints(holder, names, include_extras=True)["hint"]
    except Exception:
        return Any
