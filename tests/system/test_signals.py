"""Requests to stop are noted as they should be, and handlers are put back."""

import signal
import threading
from contextlib import suppress

import pytest

from vdgs.errors import Interrupted
from vdgs.system.stop_signals import catch_stop_signals, check_stop_requested

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers_as_before():
    """Those of a terminal, whatever the tests were started with: under nohup they inherit an ignored SIGHUP."""
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    before = [signal.getsignal(number) for number in NUMBERS]
    yield
    after = [signal.getsignal(number) for number in NUMBERS]
    signal.signal(signal.SIGHUP, inherited)
    assert after == before


def test_requests_are_noted_in_their_order():
    with catch_stop_signals(hangup=True) as asked:
        assert not asked
        for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            signal.raise_signal(number)
        assert list(asked) == [signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGINT]


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_the_second_ctrl_c_interrupts_where_asked_for(first):
    with catch_stop_signals(second_interrupts=True) as asked:
        signal.raise_signal(first)
        signal.raise_signal(signal.SIGTERM)  # a scheduler that asks twice is no impatient person
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert list(asked) == [first, signal.SIGTERM]


def test_hangup_stays_ignored_under_nohup_and_is_left_alone_where_not_asked_for():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with catch_stop_signals(hangup=True) as asked:
            signal.raise_signal(signal.SIGHUP)
            assert not asked
    finally:
        signal.signal(signal.SIGHUP, before)
    with catch_stop_signals():
        assert signal.getsignal(signal.SIGHUP) == before


def test_a_request_that_the_inner_work_had_no_time_for_stops_the_outer():
    """Ctrl-C with the last step of a stage: the stage is complete, what comes after it must not begin."""
    with catch_stop_signals(interrupts=True) as outer:
        with catch_stop_signals(second_interrupts=True) as inner:
            signal.raise_signal(signal.SIGINT)
        assert list(outer) == list(inner) == [signal.SIGINT]
        with pytest.raises(Interrupted):
            check_stop_requested()
    check_stop_requested()  # another command in this process was not asked


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
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
        with catch_stop_signals(hangup=True) as asked:
            seen.append((list(asked), signal.getsignal(signal.SIGINT)))

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [([], before)]
