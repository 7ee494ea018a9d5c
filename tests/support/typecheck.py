"""The run-time type checker of the tests: jaxtyping's shapes by beartype, for which an int is also a float (PEP 484).

`jaxtyping.jaxtyped` binds the arguments of every call and checks them apart from the result; `jaxtyped` here checks the
same in one step, in half the time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from inspect import isgeneratorfunction
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

_CONFIGURATION = BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError)
_OF_JAXTYPING = jaxtyping.jaxtyped
#: While a call lasts, a name of a size means one number.
_CALL = _OF_JAXTYPING("context")


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
        with _CALL:
            return made[0](*arguments, **named)

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
