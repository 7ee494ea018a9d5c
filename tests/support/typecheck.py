"""The run-time type checker of the tests: beartype, for which an int is also a float (PEP 484)."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from beartype import BeartypeConf, beartype

_CONFIGURATION = BeartypeConf(is_pep484_tower=True)


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is checked; the checks are generated at its first call, for a worker calls few of those that it
    imports.

    jaxtyping calls it twice for each function: for its arguments, and for its result, which has to fit the sizes that
    its arguments had. The arguments were checked then, and are not again.
    """
    result = function.__annotations__.get("return", Any)
    if result is not Any:
        function.__annotations__ = {"return": result}
    made: list[Callable[..., Any]] = []

    @wraps(function)
    def check(*arguments: Any, **named: Any) -> Any:
        if not made:
            made.append(beartype(function, conf=_CONFIGURATION))
        return made[0](*arguments, **named)

    return check
