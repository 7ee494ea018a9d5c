"""Requests to stop are noted as they should be, and handlers are put back."""

import re
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import pytest

import vdgs
from support.commands import PATIENCE_SECONDS
from vdgs.errors import Interrupted
from vdgs.system.stop_signals import STOP_SIGNALS, catch_stop_signals, check_stop_requested, stops_as_python

#: Loads pycolmap, with or without a handler of ours, then says what SIGTERM does.
LOADED = """
import importlib, signal, sys, threading
from vdgs.system.stop_signals import catch_stop_signals
with catch_stop_signals() as requests:
    load = lambda: importlib.import_module("vdgs.system.lazy_pycolmap").pycolmap.Camera  # loaded at its first use
    if sys.argv[1] == "thread":
        thread = threading.Thread(target=load)
        thread.start()
        thread.join()
    else:
        load()
    assert "pycolmap" in sys.modules
    signal.raise_signal(signal.SIGTERM)
    print("asked", *requests)
signal.raise_signal(signal.SIGTERM)
"""


@pytest.fixture(autouse=True)
def handlers_as_before():
    """Those of a terminal, whatever the tests were started with: under nohup they inherit an ignored SIGHUP."""
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    before = [signal.getsignal(number) for number in STOP_SIGNALS]
    yield
    after = [signal.getsignal(number) for number in STOP_SIGNALS]
    signal.signal(signal.SIGHUP, inherited)
    assert after == before


def test_requests_are_noted_in_their_order():
    with catch_stop_signals() as asked:
        assert not asked
        for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
        assert list(asked) == [signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGINT]


@pytest.mark.parametrize("first", STOP_SIGNALS)
def test_the_second_ctrl_c_interrupts_where_asked_for(first):
    with catch_stop_signals(second_interrupts=True) as asked:
        signal.raise_signal(first)
        signal.raise_signal(signal.SIGTERM)  # a scheduler that asks twice is no impatient person
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert list(asked) == [first, signal.SIGTERM]


def test_hangup_stays_ignored_under_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with catch_stop_signals() as asked:
            signal.raise_signal(signal.SIGHUP)
            assert not asked
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_only_ctrl_c_breaks_off_the_saving():
    """A terminal that closes sends SIGHUP twice, schedulers SIGTERM to all processes of a job and to their parent."""
    with catch_stop_signals(interrupts=True) as asked:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGHUP)
        for number in (signal.SIGHUP, signal.SIGTERM):
            signal.raise_signal(number)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert list(asked) == [signal.SIGHUP, signal.SIGHUP, signal.SIGTERM, signal.SIGINT]


@pytest.mark.parametrize("where", ["main", "thread"])
def test_pycolmap_leaves_sigterm_to_us(where):
    done = subprocess.run(
        [sys.executable, "-c", LOADED, where], capture_output=True, text=True, timeout=PATIENCE_SECONDS
    )
    assert done.stdout == f"asked {int(signal.SIGTERM)}\n", done.stderr
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")  # no trace of C++ outside of our contexts either


def test_pycolmap_is_imported_in_one_place():
    package = Path(vdgs.__file__).parent
    direct = re.compile(r"^\s*(import|from) pycolmap", re.MULTILINE)
    found = [str(file.relative_to(package)) for file in package.rglob("*.py") if direct.search(file.read_text())]
    assert found == ["system/lazy_pycolmap.py"]


def test_a_request_that_the_inner_work_had_no_time_for_stops_the_outer():
    """Ctrl-C with the last step of a stage: the stage is complete, what comes after it must not begin."""
    with catch_stop_signals(interrupts=True) as outer:
        with catch_stop_signals(second_interrupts=True) as inner:
            signal.raise_signal(signal.SIGINT)
        assert list(outer) == list(inner) == [signal.SIGINT]
        with pytest.raises(Interrupted):
            check_stop_requested()
    check_stop_requested()  # another command in this process was not asked


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_an_interrupt_that_was_swallowed_is_not_forgotten(number):
    with catch_stop_signals(interrupts=True):
        check_stop_requested()
        with suppress(KeyboardInterrupt):  # as in a callback of a library
            signal.raise_signal(number)
        with pytest.raises(Interrupted):
            check_stop_requested()


def test_outside_the_main_thread_nothing_is_noted():
    seen = []

    def work() -> None:
        with catch_stop_signals() as asked:
            seen.append((list(asked), signal.getsignal(signal.SIGINT)))

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [([], before)]


def work(moment: str) -> None:
    """Work of vdgs that Ctrl-C meets before, in, or at the end of a part that saves on it."""
    if moment == "before":
        signal.raise_signal(signal.SIGINT)
    with catch_stop_signals() as asked:
        if moment in ("within", "late"):
            signal.raise_signal(signal.SIGINT)
        if asked and moment == "within":
            check_stop_requested()


@pytest.mark.parametrize("moment", ["before", "within", "late"])
def test_ctrl_c_is_pythons_own_whenever_it_comes(moment):
    with pytest.raises(KeyboardInterrupt), stops_as_python():
        work(moment)
    with stops_as_python():
        work("never")


def terminated(told: list[int]) -> None:
    with stops_as_python(), catch_stop_signals() as asked:
        signal.raise_signal(signal.SIGTERM)
        assert (list(asked), told) == ([signal.SIGTERM], [])
        check_stop_requested()


def test_other_signals_are_the_callers_after_work_has_ended():
    told = []
    before = signal.signal(signal.SIGTERM, lambda number, _frame: told.append(number))
    try:
        with pytest.raises(KeyboardInterrupt):
            terminated(told)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert told == [signal.SIGTERM]
