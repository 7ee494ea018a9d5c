"""Signals that ask this process to stop: noted, so that work ends where it is whole, instead of breaking it off."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


@contextmanager
def stop_requests(*, hangup: bool = False, second_interrupts: bool = False) -> Iterator[Sequence[int]]:
    """The signals that asked to stop while the context lasts, in their order: Ctrl-C (SIGINT) and SIGTERM.

    With `hangup` also SIGHUP, unless it is ignored: nohup means it. With `second_interrupts`, Ctrl-C after any other
    request raises KeyboardInterrupt at once. Outside the main thread, where Python allows no handlers, none is noted.
    """
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(number: int, _frame: object) -> None:
        if second_interrupts and asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.append(number)

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hangup and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
