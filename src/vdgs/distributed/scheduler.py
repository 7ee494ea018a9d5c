"""The tasks of one call, whatever engine begins them: which wait, which run, which are tried again, how each ended.

All that a person sees of a failure is worded here, so that every engine says it in the same words.
"""

from __future__ import annotations

import shutil
import signal
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from vdgs.distributed.executor import (
    EXIT_DONE,
    EXIT_EXPLAINED,
    EXIT_STOPPED,
    Attempt,
    AttemptResult,
    EndState,
    Engine,
    Task,
    TaskListener,
    TaskResult,
)
from vdgs.distributed.task_process import error_message, tail_lines
from vdgs.errors import VdgsError
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.stop_signals import catch_stop_signals
from vdgs.system.units import data_size

#: Seconds that tasks get to save when this process fails itself, and between two looks at them meanwhile.
GRACE_SECONDS, GRACE_POLL_SECONDS = 120.0, 0.05
#: Free bytes below which a silent failure is put down to a full disk.
DISK_FULL_BYTES = 1 << 20
#: What a task asks for after it was ended for want of memory, times what it asked for before (choice).
MEMORY_RETRY_FACTOR = 1.5


@dataclass(frozen=True)
class ExecutionPolicy:
    """How many tasks run side by side, how often one that crashes is started again, and how often all are looked at."""

    max_concurrent: int
    retries: int = 2
    poll_seconds: float = 0.5
    lock_timeout_seconds: float = 60.0
    """How long to wait for a process that still holds a task's folder, such as one whose driver was killed and that
    saves."""

    def __post_init__(self) -> None:
        if self.max_concurrent < 1 or self.retries < 0:
            raise ValueError(
                f"at_once is {self.max_concurrent} and retries is {self.retries}: at least 1 and 0 are needed"
            )


def run_tasks(
    tasks: Sequence[Task], engine: Engine, policy: ExecutionPolicy, listener: TaskListener
) -> list[TaskResult]:
    """As `Executor.run`, with the attempts of an engine. A second Ctrl-C kills those that still run."""
    with catch_stop_signals(hangup=True) as asked:
        crew = _TaskScheduler([_TaskState(task) for task in tasks], engine, policy, listener)
        try:
            while not crew.step(asked):
                time.sleep(policy.poll_seconds)
        finally:
            crew.abandon()
    return [work.outcome for work in crew.works if work.outcome is not None]


class _TaskState:
    """A task and the attempt that is made at it."""

    def __init__(self, task: Task):
        self.task = task
        self.attempt: Attempt | None = None
        self.outcome: TaskResult | None = None
        self.attempts = 0
        self.asked_to_stop = False
        #: Whether it was told that this attempt began, when it did, and where its output begins.
        self.told, self.began, self.output_from = False, 0.0, 0
        #: Whether an earlier driver began it.
        self.found = False
        #: Since when another process is seen to work on it.
        self.held_since: float | None = None
        #: How far it was when its time was last up.
        self.progress = -1

    def ask_to_stop(self) -> None:
        if self.attempt is not None and not self.asked_to_stop:
            self.asked_to_stop = True
            self.attempt.request_stop()


class _TaskScheduler:
    """The tasks of one call."""

    def __init__(self, works: list[_TaskState], engine: Engine, policy: ExecutionPolicy, listener: TaskListener):
        self.works, self._engine, self._listener = works, engine, listener
        self._at_once, self._retries, self._patience = (
            policy.max_concurrent,
            policy.retries,
            policy.lock_timeout_seconds,
        )
        self._by_name = {work.task.name: work for work in works}
        self._waiting = deque(works)
        self._stopping = False
        for work in works:
            self._adopt(work)

    @property
    def _running(self) -> list[_TaskState]:
        return [work for work in self.works if work.attempt is not None]

    def step(self, signals: Sequence[int]) -> bool:
        """Judge what ended, pass on what was `asked` (signals), start what there is room for. True when all ended."""
        if self._running:
            self._engine.refresh()
        for work in self._running:
            self._poll(work)
        if signals:
            self._stop(kill=signal.SIGINT in signals[1:])
        self._start_ready()
        self._listener.on_tick()
        return not self._waiting and not self._running

    def abandon(self) -> None:
        """Leave no process behind when this one fails itself."""
        for work in self._running:
            work.ask_to_stop()
        end = time.monotonic() + GRACE_SECONDS
        left = self._running
        while left and time.monotonic() < end:
            self._engine.refresh()
            left = [work for work in left if work.attempt is not None and work.attempt.poll() is None]
            time.sleep(GRACE_POLL_SECONDS if left else 0)
        for work in left:
            assert work.attempt is not None
            work.attempt.kill()

    def _adopt(self, work: _TaskState) -> None:
        """Watch what an earlier driver began, if it still goes on."""
        attempt = self._engine.find_running(work.task)
        if attempt is not None:
            self._waiting.remove(work)
            work.attempt, work.found, work.attempts = attempt, True, 1

    def _poll(self, work: _TaskState) -> None:
        assert work.attempt is not None
        end = work.attempt.poll()
        self._report_start(work)
        if end is not None:
            work.attempt = None
            self._judge(work, end)

    def _report_start(self, work: _TaskState) -> None:
        """Pass on that an attempt has found a place, or lost it again."""
        assert work.attempt is not None
        begun = work.attempt.start_info
        if begun is not None and not work.told:
            work.told, work.began, work.output_from = True, time.monotonic(), begun.output_from
            if begun.where:
                self._listener.on_placed(work.task, begun.where, work.found)
            self._listener.on_started(work.task, work.attempts)
        elif begun is None and work.told:
            work.told = False
            self._listener.on_paused(work.task, "")

    def _start_ready(self) -> None:
        ready = list[_TaskState]()
        for work in list(self._waiting):
            before = self._by_name.get(work.task.after) if work.task.after is not None else None
            end = before.outcome if before is not None else None
            room = len(self._running) + len(ready) < self._at_once
            if end is not None and end.state != "done":
                self._waiting.remove(work)
                self._start(ready)
                self._end(work, end.state, f"{end.name} {end.state}: {end.reason}")
            elif room and (before is None or end is not None) and not self._is_locked_elsewhere(work):
                self._waiting.remove(work)
                ready.append(work)
        self._start(ready)

    def _start(self, ready: list[_TaskState]) -> None:
        """Begin an attempt at each; the list is empty then."""
        works = list(ready)
        ready.clear()
        for work in works:
            work.attempts += 1
            work.told = work.found = work.asked_to_stop = False
        attempts = self._engine.start([(work.task, work.attempts) for work in works]) if works else ()
        for work, attempt in zip(works, attempts, strict=True):
            if isinstance(attempt, OSError):
                self._end(work, "failed", _start_error_text(work.task, attempt))
            else:
                work.attempt = attempt
                self._report_start(work)

    def _is_locked_elsewhere(self, work: _TaskState) -> bool:
        """Another process still works on the task, and patience is not at an end (then the task says so itself)."""
        if work.task.folder is None or not StageFolder(work.task.folder).is_locked_elsewhere():
            return False
        if work.held_since is None:
            work.held_since = time.monotonic()
            self._listener.on_waiting(work.task)
        return time.monotonic() - work.held_since < self._patience

    def _stop(self, kill: bool) -> None:
        if not self._stopping:
            self._stopping = True
            while self._waiting:
                self._end(self._waiting.popleft(), "stopped", "not started")
            if begun := [work.task for work in self._running if work.told]:
                self._listener.on_stopping(begun)
        for work in self._running:
            work.ask_to_stop()
            if kill and work.attempt is not None:
                work.attempt.kill()

    def _judge(self, work: _TaskState, end: AttemptResult) -> None:
        code, why = end.code, error_message(work.task.output, work.output_from) if work.told else ""
        if code == EXIT_DONE:
            self._end(work, "done")
        elif self._stopping and not work.told:
            work.attempts -= 1
            self._end(work, "stopped", "not started")
        elif end.out_of_time and not self._stopping:
            self._out_of_time(work, why)
        elif code == EXIT_STOPPED:
            self._end(work, "stopped", why if work.asked_to_stop else f"stopped by someone else. {why}".strip())
        elif code in EXIT_EXPLAINED:
            self._end(work, "failed", why or _silent_failure_text(work.task, _end_text(end)))
        elif self._stopping:
            self._end(work, "stopped", f"ended by {_end_text(end)}; continues from its last checkpoint")
        else:
            self._crashed(work, end, why)

    def _out_of_time(self, work: _TaskState, why: str) -> None:
        """It saved and goes on in its next turn; no attempt is lost as long as it gets further from turn to turn."""
        progress = stage_iteration(work.task.folder)
        if progress > work.progress:
            work.progress, work.attempts = progress, work.attempts - 1
            self._listener.on_paused(work.task, why)
            self._waiting.append(work)
        else:
            self._crashed(work, AttemptResult(None, "its time limit, before it got any further"), why)

    def _crashed(self, work: _TaskState, end: AttemptResult, why: str) -> None:
        how = _end_text(end)
        if end.out_of_memory:
            how += f" (out of memory; {self._after_memory_kill(work)})"
        work.held_since = None
        if work.attempts > self._retries:
            times = f"crashed {work.attempts} times, at last by {how}" if self._retries else f"crashed by {how}"
            self._end(work, "failed", f"{times}. {why}".strip())
            return
        self._listener.on_crashed(work.task, how, self._retries + 1 - work.attempts)
        self._waiting.append(work)

    def _after_memory_kill(self, work: _TaskState) -> str:
        """Ask for more memory, where places are found by needs, else run fewer at once; what to say of it."""
        most = self._engine.max_memory_bytes
        if most is None:
            self._at_once = max(1, self._at_once - 1)
            return f"from now on at most {self._at_once} at once"
        needs = work.task.resources
        more = min(round(MEMORY_RETRY_FACTOR * needs.memory_bytes), max(most, needs.memory_bytes))
        if more <= needs.memory_bytes:
            return f"no node has more than the {data_size(needs.memory_bytes)} that it asked for"
        work.task = replace(work.task, resources=replace(needs, memory_bytes=more))
        return f"it asks for {data_size(more)} now"

    def _end(self, work: _TaskState, state: EndState, why: str = "") -> None:
        seconds = time.monotonic() - work.began if work.attempts and work.began else 0.0
        lines = tuple(tail_lines(work.task.output, work.output_from)) if state == "failed" and work.told else ()
        work.outcome = TaskResult(
            name=work.task.name, state=state, attempts=work.attempts, seconds=seconds, reason=why, last_lines=lines
        )
        self._listener.on_ended(work.task, work.outcome)


def stage_iteration(folder: Path | None) -> int:
    """How many iterations the stage in a folder has told; 0 where it tells nothing."""
    if folder is None:
        return 0
    try:
        return StageFolder(folder).status().iteration or 0
    except (VdgsError, OSError):
        return 0


def _end_text(end: AttemptResult) -> str:
    code = end.code
    if code is None:
        return end.reason
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _start_error_text(task: Task, error: OSError) -> str:
    return (
        f"{error.filename or task.output}: {error.strerror or error}. Free some space or mend the folder, "
        "then run the same command again."
    )


def _silent_failure_text(task: Task, end: str) -> str:
    """What to say of a task that failed and printed nothing."""
    folder = task.output.parent
    with suppress(OSError):
        if shutil.disk_usage(folder).free < DISK_FULL_BYTES:
            return f"{folder}: the disk is full. Free some space, then run the same command again."
    return f"{end}, without a message"
