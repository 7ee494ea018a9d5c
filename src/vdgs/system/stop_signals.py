"""Signals that ask this process to stop: noted, so that work ends where it is whole, instead of breaking it off.

A request is noted by every context that lasts when it comes, so that one which the innermost had no time to serve (it
came with the last step of a training) is served by those around it: `check_stop_requested`, which all that works long
calls where it is whole. An exception alone would not do: raised in a callback of a library, it may be swallowed there.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from vdgs.errors import Interrupted

#: What the contexts that last have noted, the outermost first.
_noted: list[list[int]] = []


@contextmanager
def catch_stop_signals(
    *, hangup: bool = False, second_interrupts: bool = False, interrupts: bool = False
) -> Iterator[Sequence[int]]:
    """The signals that asked to stop while the context lasts, in their order: Ctrl-C (SIGINT) and SIGTERM.

    With `hangup` also SIGHUP, unless it is ignored: nohup means it. With `second_interrupts`, Ctrl-C after any other
    request raises KeyboardInterrupt at once; with `interrupts` every request does. Outside the main thread, where
    Python allows no handlers, none is noted.
    """
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(number: int, _frame: object) -> None:
        if second_interrupts and asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        for noted in _noted:
            noted.append(number)
        if interrupts:
            raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hangup and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    _noted.append(asked)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _noted.pop()


def check_stop_requested() -> None:
    """Raise Interrupted if a context that lasts has noted a request: also one whose exception was swallowed."""
    if any(_noted):
        raise Interrupted("interrupted. The same command continues.")
