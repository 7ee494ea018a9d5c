"""Signals that ask this process to stop are recorded, so that work ends at a consistent state.

Every active context records a request: if the innermost one ends before it reacts, the outer ones do, by calling
`check_stop_requested`. An exception in the handler could be swallowed by a library's callback.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from vdgs.errors import Interrupted, Stopped

#: Ctrl-C, what schedulers and `kill` send, and the end of a terminal or connection.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: The requests recorded by each active context, the outermost first.
_recorded: list[list[int]] = []


@contextmanager
def catch_stop_signals(*, second_interrupts: bool = False, interrupts: bool = False) -> Iterator[Sequence[int]]:
    """The stop signals received while the context is active, in order; SIGHUP is none where it is ignored (nohup).

    With `second_interrupts`, Ctrl-C after any other request raises KeyboardInterrupt at once; with `interrupts` the
    first request does too. Other signals never interrupt twice: a terminal that closes sends several, and what they
    would break off is the saving. Outside the main thread nothing is recorded.
    """
    requests: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield requests
        return

    def ask(number: int, _frame: object) -> None:
        _discard_output_without_reader()
        if second_interrupts and requests and number == signal.SIGINT:
            raise KeyboardInterrupt
        first = not requests
        for recorded in _recorded:
            recorded.append(number)
        if interrupts and (first or number == signal.SIGINT):
            raise KeyboardInterrupt

    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    numbers = [number for number in STOP_SIGNALS if hangs_up or number != signal.SIGHUP]
    _recorded.append(requests)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield requests
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _recorded.pop()


@contextmanager
def stops_as_python() -> Iterator[None]:
    """Stop signals as other Python code has them: Ctrl-C is KeyboardInterrupt, whenever it comes, which no `except
    Exception` of a caller takes for a failure; what else the caller does on a signal is done after work has ended at a
    consistent state (nothing: the process ends by the signal)."""
    received: list[int] = []
    try:
        with catch_stop_signals(interrupts=True) as requests:
            try:
                yield
            finally:
                received += requests
    except Stopped as error:
        _deliver(received)
        raise KeyboardInterrupt(str(error).replace("The same command", "The same call")) from None
    except KeyboardInterrupt:
        _deliver(received)
        raise
    if received:  # in the last moments of work that had no more step to stop at
        _deliver(received)
        raise KeyboardInterrupt


def _deliver(numbers: Sequence[int]) -> None:
    """Let the handlers of the caller have the signals that ours took. Python's own of Ctrl-C raises what is raised."""
    for number in dict.fromkeys(numbers):
        if signal.getsignal(number) is not signal.default_int_handler:
            signal.raise_signal(number)


def check_stop_requested() -> None:
    """Raise Interrupted if an active context has recorded a request, even if its exception was swallowed."""
    if any(_recorded):
        raise Interrupted("interrupted. The same command continues.")


@contextmanager
def preserve_signal_handlers() -> Iterator[None]:
    """Put back the handlers of stop signals that a library replaces when it is imported or started.

    Outside the main thread those of the C library are put back, which is what a library in C++ replaces.
    """
    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.getsignal(number) for number in STOP_SIGNALS}
        try:
            yield
        finally:
            for number, handler in handlers.items():
                if handler is not None:  # one that Python did not set
                    signal.signal(number, handler)
        return
    get, put = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
    get.argtypes, put.argtypes = [ctypes.c_int], [ctypes.c_int, ctypes.c_void_p]
    get.restype = put.restype = ctypes.c_void_p
    addresses = {number: get(number) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        for number, address in addresses.items():
            put(number, address)


def _discard_output_without_reader() -> None:
    """Send output nowhere that has lost its terminal or reader: its error would break off the saving."""
    poll = select.poll()
    for descriptor in (1, 2):
        poll.register(descriptor, 0)
    for descriptor, events in poll.poll(0):
        if events & (select.POLLERR | select.POLLHUP):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, descriptor)
            os.close(nowhere)
