"""Signals that ask this process to stop are recorded, so that work ends at a consistent state.

Every active context records a request: if the innermost one ends before it reacts, the outer ones do, by calling
`check_stop_requested`. An exception in the handler could be swallowed by a library's callback.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from vdgs.errors import Interrupted

#: The requests recorded by each active context, the outermost first.
_recorded: list[list[int]] = []


@contextmanager
def catch_stop_signals(
    *, hangup: bool = False, second_interrupts: bool = False, interrupts: bool = False
) -> Iterator[Sequence[int]]:
    """The stop signals received while the context is active, in order: Ctrl-C (SIGINT) and SIGTERM.

    With `hangup` also SIGHUP, unless it is ignored (nohup). With `second_interrupts`, Ctrl-C after any other request
    raises KeyboardInterrupt at once; with `interrupts` every request does. Outside the main thread nothing is recorded.
    """
    requests: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield requests
        return

    def ask(number: int, _frame: object) -> None:
        if second_interrupts and requests and number == signal.SIGINT:
            raise KeyboardInterrupt
        for recorded in _recorded:
            recorded.append(number)
        if interrupts:
            raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hangup and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    _recorded.append(requests)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield requests
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _recorded.pop()


def check_stop_requested() -> None:
    """Raise Interrupted if an active context has recorded a request, even if its exception was swallowed."""
    if any(_recorded):
        raise Interrupted("interrupted. The same command continues.")
