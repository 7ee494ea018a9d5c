"""A plugin that lists the tests which cost most processor time, with all processes that they start (Linux, no workers):

PYTHONPATH=tests python -m pytest -n 0 -p support.processor_time tests/integration/test_ray.py
"""

from __future__ import annotations

import os
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

import pytest

LISTED = 30
_spent: dict[str, float] = {}
_last = 0.0


def processor_seconds() -> float:
    """Of this process, of its descendants that live, and of those that any of them has waited for."""
    children, ticks = defaultdict[int, list[int]](list), dict[int, int]()
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            with suppress(OSError):
                facts = (folder / "stat").read_text().rpartition(")")[2].split()
                children[int(facts[1])].append(int(folder.name))
                ticks[int(folder.name)] = sum(map(int, facts[11:15]))
    found, total = [os.getpid()], 0
    while found:
        process = found.pop()
        total += ticks.get(process, 0)
        found += children[process]
    return total / os.sysconf("SC_CLK_TCK")


def _note(name: str) -> None:
    global _last
    now = processor_seconds()
    _spent[name] = _spent.get(name, 0.0) + now - _last
    _last = now


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_logstart(nodeid: str) -> None:
    _note("imports, and what belongs to no test")


@pytest.hookimpl(trylast=True)
def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _note(f"{report.when} {report.nodeid}")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    terminalreporter.section(f"{sum(_spent.values()):.1f} s of processor time")
    for name, seconds in sorted(_spent.items(), key=lambda item: -item[1])[:LISTED]:
        terminalreporter.write_line(f"{seconds:7.2f} {name}")
