"""Several runs at once, each in a process of its own. One that fails stops no other; Ctrl-C lets all of them save."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vdgs.executors.output import explanation
from vdgs.executors.parent import PARENT

POLL_SECONDS = 0.2
#: Seconds in which a process that was asked to stop may save.
GRACE_SECONDS = 120.0


@dataclass(frozen=True)
class Task:
    """A job file and where the output goes. `after`: the name of the task that must be done before."""

    name: str
    file: Path
    output: Path
    after: str | None = None


@dataclass(frozen=True)
class Ended:
    """How a task ended."""

    name: str
    state: Literal["done", "failed", "stopped"]
    seconds: float = 0.0
    why: str = ""


@dataclass
class _Running:
    task: Task
    process: subprocess.Popen[bytes]
    began: float
    output_from: int


def run_tasks(tasks: Sequence[Task], at_once: int, tell: Callable[[str, Ended | None], None]) -> dict[str, Ended]:
    """Work off the tasks in their order, at most `at_once` at a time.

    `tell(name, None)` when one starts, `tell(name, ended)` when it ended. A task whose predecessor failed is not
    started. After Ctrl-C or SIGTERM no more are started, and the running ones are asked to save and end: they and the
    rest are "stopped".
    """
    waiting, running, ended = list(tasks), list[_Running](), dict[str, Ended]()
    with _stop_requests() as asked:
        try:
            while waiting or running:
                if asked:
                    ended |= {task.name: Ended(task.name, "stopped") for task in waiting}
                    waiting.clear()
                    _stop(running)
                _start_ready(waiting, running, ended, at_once, tell)
                for each in [each for each in running if each.process.poll() is not None]:
                    running.remove(each)
                    ended[each.task.name] = result = _ended(each, bool(asked))
                    tell(each.task.name, result)
                time.sleep(POLL_SECONDS)
        finally:
            _stop(running)
            for each in running:
                each.process.wait(GRACE_SECONDS)
    return ended


def _start_ready(
    waiting: list[Task], running: list[_Running], ended: dict[str, Ended], at_once: int,
    tell: Callable[[str, Ended | None], None],
) -> None:  # fmt: skip
    """Start tasks while there is room; those whose predecessor did not end well end with it."""
    names = {task.name for task in waiting} | {each.task.name for each in running}
    for task in list(waiting):
        before = ended.get(task.after) if task.after else None
        if before is not None and before.state != "done":
            waiting.remove(task)
            ended[task.name] = Ended(task.name, before.state, why=f"{task.after} {before.state}: {before.why}")
            tell(task.name, ended[task.name])
        elif len(running) < at_once and task.after not in names:
            waiting.remove(task)
            running.append(_begin(task))
            tell(task.name, None)


def _begin(task: Task) -> _Running:
    task.output.parent.mkdir(parents=True, exist_ok=True)
    with task.output.open("ab") as output:
        start = output.tell()
        process = subprocess.Popen(
            [sys.executable, "-m", "vdgs.bench.worker", str(task.file)],
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1", PARENT: str(os.getpid()), "OMP_WAIT_POLICY": "PASSIVE"},
        )  # fmt: skip
    return _Running(task, process, time.monotonic(), start)


def _ended(each: _Running, asked: bool) -> Ended:
    code, seconds = each.process.returncode, time.monotonic() - each.began
    if code == 0:
        return Ended(each.task.name, "done", seconds)
    if code == 130 or (asked and code == -signal.SIGTERM):  # one that had not begun to train ends at once
        return Ended(each.task.name, "stopped", seconds)
    said = explanation(each.task.output, each.output_from)
    how = said or f"exit code {code}"
    if code < 0:  # what was said last is then no explanation
        how = f"ended by {signal.Signals(-code).name}" + (" (out of memory?)" if code == -signal.SIGKILL else "")
    return Ended(each.task.name, "failed", seconds, how)


def _stop(running: Sequence[_Running]) -> None:
    for each in running:
        if each.process.poll() is None:
            each.process.terminate()


@contextmanager
def _stop_requests() -> Iterator[list[int]]:
    asked: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, _frame: asked.append(number)) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
