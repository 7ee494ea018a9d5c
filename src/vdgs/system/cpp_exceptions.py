"""Exceptions that leave a thread of C++: they would end the process at once, with a stack trace and nothing said."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_Handler = ctypes.CFUNCTYPE(None)
#: Handlers that threads may hang in stay alive.
_handlers: list[Any] = []


@contextmanager
def catch_in_threads(tell: Callable[[], object]) -> Iterator[None]:
    """A context in which `tell` is called, in such a thread, where it would end the process; the thread then stands
    still for good, and so does what waits for it. Nothing changes where the library of C++ is not found."""
    set_terminate = _set_terminate()
    if set_terminate is None:
        yield
        return

    def stand_still() -> None:
        tell()
        threading.Event().wait()

    handler = _Handler(stand_still)
    before = set_terminate(ctypes.cast(handler, ctypes.c_void_p))
    _handlers[:] = [handler]
    try:
        yield
    finally:
        set_terminate(before)


def _set_terminate() -> Any:
    """std::set_terminate of the library that is loaded, or None."""
    for name in ("libstdc++.so.6", "libc++abi.dylib"):
        try:
            function = ctypes.CDLL(name)._ZSt13set_terminatePFvvE
        except (OSError, AttributeError):
            continue
        function.restype, function.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
        return function
    return None
