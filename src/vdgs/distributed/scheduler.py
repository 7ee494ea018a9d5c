"""Schedules the tasks of one call, whatever engine begins them: which wait, which run, which are tried again, how each
ended. All messages about failures are worded here, so that every engine uses the same words.
"""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Iterable, Sequence
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
from vdgs.system.atomic_files import is_disk_full
from vdgs.system.stop_signals import catch_stop_signals
from vdgs.system.units import data_size

#: Seconds that tasks get to save when this process fails itself, and between two polls meanwhile.
GRACE_SECONDS, GRACE_POLL_SECONDS = 120.0, 0.05
#: What a task asks for after it was ended for want of memory, times what it asked for before (choice).
MEMORY_RETRY_FACTOR = 1.5
#: So many nodes that cannot work on the run cost a task no attempt: where most cannot, the others are not searched for.
MAX_NODE_REJECTIONS = 8


@dataclass(frozen=True)
class ExecutionPolicy:
    """How many tasks run side by side, how often one that crashes is started again, and how often all are polled."""

    max_concurrent: int
    retries: int = 2
    poll_seconds: float = 0.5
    lock_timeout_seconds: float = 60.0
    """How long to wait for a process that still holds a task's folder: one whose driver was killed, and that saves."""
    max_per_device: int = 0
    """How many tasks that name the same device run side by side; 0: no limit but `max_concurrent`."""

    def __post_init__(self) -> None:
        if self.max_concurrent < 1 or self.retries < 0:
            raise ValueError(
                f"max_concurrent is {self.max_concurrent}, retries is {self.retries}; at least 1 and 0 are needed"
            )


def run_tasks(
    tasks: Sequence[Task], engine: Engine, policy: ExecutionPolicy, listener: TaskListener
) -> list[TaskResult]:
    """As `Executor.run`, with the attempts of an engine. A second Ctrl-C kills those that still run."""
    with catch_stop_signals() as signals:
        scheduler = _TaskScheduler([_TaskState(task) for task in tasks], engine, policy, listener)
        try:
            while not scheduler.step(signals):
                time.sleep(policy.poll_seconds)
        finally:
            scheduler.abandon()
    return [state.result for state in scheduler.states if state.result is not None]


class _TaskState:
    """A task and its present attempt."""

    def __init__(self, task: Task):
        self.task = task
        self.attempt: Attempt | None = None
        self.result: TaskResult | None = None
        self.attempts = 0
        self.stop_requested = False
        #: Whether the start of this attempt was reported, its time, and where its output begins.
        self.started, self.start_time, self.output_from = False, 0.0, 0
        #: Whether an earlier driver began it.
        self.resumed = False
        #: Since when another process is seen to work on it.
        self.locked_since: float | None = None
        #: How many iterations it had when its time was last up.
        self.progress = -1
        #: How many nodes could not work on the run.
        self.rejections = 0

    def request_stop(self) -> None:
        if self.attempt is not None and not self.stop_requested:
            self.stop_requested = True
            self.attempt.request_stop()


class _TaskScheduler:
    """The tasks of one call."""

    def __init__(self, states: list[_TaskState], engine: Engine, policy: ExecutionPolicy, listener: TaskListener):
        self.states, self._engine, self._policy, self._listener = states, engine, policy, listener
        self._max_concurrent = policy.max_concurrent
        self._by_name = {state.task.name: state for state in states}
        self._waiting = deque(states)
        self._stopping = False
        for state in states:
            if (attempt := engine.find_running(state.task)) is not None:
                self._waiting.remove(state)
                state.attempt, state.resumed, state.attempts = attempt, True, 1

    @property
    def _running(self) -> list[_TaskState]:
        return [state for state in self.states if state.attempt is not None]

    def step(self, signals: Sequence[int]) -> bool:
        """Judge what ended, pass on the signals that came, start what there is room for. True when all ended."""
        if self._running:
            self._engine.refresh()
        for state in self._running:
            self._poll(state)
        if signals:
            self._stop(kill=signal.SIGINT in signals[1:])
        self._start_ready()
        self._listener.on_tick()
        return not self._waiting and not self._running

    def abandon(self) -> None:
        """Leave no process behind when this one fails itself."""
        left = self._running
        for state in left:
            state.request_stop()
        end = time.monotonic() + GRACE_SECONDS
        while left and time.monotonic() < end:
            self._engine.refresh()
            left = [state for state in left if state.attempt is not None and state.attempt.poll() is None]
            time.sleep(GRACE_POLL_SECONDS if left else 0)
        for state in left:
            assert state.attempt is not None
            state.attempt.kill()

    def _poll(self, state: _TaskState) -> None:
        assert state.attempt is not None
        end = state.attempt.poll()
        self._report_start(state)
        if end is not None:
            state.attempt = None
            self._judge(state, end)

    def _report_start(self, state: _TaskState) -> None:
        """Report that an attempt has found a place, or lost it again."""
        assert state.attempt is not None
        info = state.attempt.start_info
        if info is not None and not state.started:
            state.started, state.start_time, state.output_from = True, time.monotonic(), info.output_from
            if info.where:
                self._listener.on_placed(state.task, info.where, state.resumed)
            self._listener.on_started(state.task, state.attempts)
        elif info is None and state.started:
            state.started = False
            self._listener.on_paused(state.task, "")

    def _start_ready(self) -> None:
        """Begin what there is room for; what another process works on comes last, as it only waits in its place."""
        ready, locked = list[_TaskState](), list[_TaskState]()
        for state in list(self._waiting):
            before = self._by_name.get(state.task.after) if state.task.after is not None else None
            end = before.result if before is not None else None
            if end is not None and end.state != "done":
                self._waiting.remove(state)
                self._start(ready)
                self._end(state, end.state, f"{end.name} {end.state}: {end.reason}")
            elif (before is None or end is not None) and self._has_room(state.task, ready):
                if self._is_locked_elsewhere(state):
                    locked.append(state)
                    continue
                self._waiting.remove(state)
                ready.append(state)
        for state in locked:
            if self._was_waited_for(state) and self._has_room(state.task, ready):
                self._waiting.remove(state)
                ready.append(state)
        self._start(ready)

    def _has_room(self, task: Task, ready: Sequence[_TaskState]) -> bool:
        """Whether a task can run beside those that run and those that are to be started."""
        return len(self._running) + len(ready) < self._max_concurrent and not self._is_full(task, ready)

    def _is_full(self, task: Task, ready: Sequence[_TaskState]) -> bool:
        """Whether the device of a task has as many others as it has room for."""
        device, most = task.resources.device, self._policy.max_per_device
        others = [state for state in (*self._running, *ready) if state.task.resources.device == device]
        return bool(device) and 0 < most <= len(others)

    def _start(self, ready: list[_TaskState]) -> None:
        """Begin an attempt at each; the list is empty then."""
        states = list(ready)
        ready.clear()
        for state in states:
            state.attempts += 1
            state.started = state.resumed = state.stop_requested = False
        attempts = self._engine.start([(state.task, state.attempts) for state in states]) if states else ()
        for state, attempt in zip(states, attempts, strict=True):
            if isinstance(attempt, OSError):
                self._end(state, "failed", _start_error_text(state.task, attempt))
            else:
                state.attempt = attempt
                self._report_start(state)

    def _is_locked_elsewhere(self, state: _TaskState) -> bool:
        """Whether another process works on the task; what waits for it is told once."""
        if state.task.folder is None or not StageFolder(state.task.folder).is_locked_elsewhere():
            return False
        if state.locked_since is None:
            state.locked_since = time.monotonic()
            self._listener.on_waiting(state.task)
        return True

    def _was_waited_for(self, state: _TaskState) -> bool:
        """Whether the time to wait here for who works on a locked task is over: then the task itself waits on, as that
        of a block does, or fails and says why."""
        return (
            state.locked_since is not None
            and time.monotonic() - state.locked_since >= self._policy.lock_timeout_seconds
        )

    def _stop(self, kill: bool) -> None:
        if not self._stopping:
            self._stopping = True
            while self._waiting:
                self._end(self._waiting.popleft(), "stopped", "not started")
            if started := [state.task for state in self._running if state.started]:
                self._listener.on_stopping(started)
            if queued := [state.task for state in self._running if not state.started]:
                self._listener.on_withdrawing(queued)
        for state in self._running:
            state.request_stop()
            if kill and state.attempt is not None:
                state.attempt.kill()

    def _judge(self, state: _TaskState, end: AttemptResult) -> None:
        code, why = end.code, error_message(state.task.output, state.output_from) if state.started else ""
        if code == EXIT_DONE:
            self._end(state, "done")
        elif self._stopping and not state.started:
            state.attempts -= 1
            self._end(state, "stopped", "not started")
        elif end.out_of_time and not self._stopping:
            self._out_of_time(state, why)
        elif code == EXIT_STOPPED:
            self._end(state, "stopped", why if state.stop_requested else f"stopped by someone else. {why}".strip())
        elif code in EXIT_EXPLAINED:
            self._end(state, "failed", why or _silent_failure_text(state.task, _end_text(end)))
        elif self._stopping:
            reason = f"ended by {_end_text(end)}; continues from its last checkpoint"
            self._end(state, "stopped", reason, was_killed=True)
        elif end.refused:
            self._end(state, "failed", _end_text(end))
        elif end.node_rejected and state.rejections < MAX_NODE_REJECTIONS:  # no attempt of its own
            state.attempts, state.rejections = state.attempts - 1, state.rejections + 1
            self._listener.on_crashed(state.task, _end_text(end), self._policy.retries + 1 - state.attempts)
            self._waiting.append(state)
        else:
            self._crashed(state, end, why)

    def _out_of_time(self, state: _TaskState, why: str) -> None:
        """It saved and goes on in its next turn; no attempt is lost as long as each turn gets further."""
        progress = stage_iteration(state.task.folder)
        if progress > state.progress:
            state.progress, state.attempts = progress, state.attempts - 1
            self._listener.on_paused(state.task, why)
            self._waiting.append(state)
        else:
            self._crashed(state, AttemptResult(None, "its time limit, before it got any further"), why)

    def _crashed(self, state: _TaskState, end: AttemptResult, why: str) -> None:
        how, retries = _end_text(end), self._policy.retries
        if end.out_of_memory:
            how += f" (out of memory; {self._after_memory_kill(state)})"
        state.locked_since = None
        if state.attempts > retries:
            times = f"crashed {state.attempts} times, at last by {how}" if retries else f"crashed by {how}"
            self._end(state, "failed", f"{times}. {why}".strip())
            return
        self._listener.on_crashed(state.task, how, retries + 1 - state.attempts)
        self._waiting.append(state)

    def _after_memory_kill(self, state: _TaskState) -> str:
        """Ask for more memory where tasks are placed by their resources, else run fewer at once; returns which."""
        available = self._engine.max_memory_bytes
        if available is None:
            self._max_concurrent = max(1, self._max_concurrent - 1)
            return f"from now on at most {self._max_concurrent} at once"
        resources = state.task.resources
        requested = resources.memory_bytes
        increased = min(round(MEMORY_RETRY_FACTOR * requested), max(available, requested))
        if increased <= requested:
            return f"no node has more than the {data_size(requested)} that it asked for"
        state.task = replace(state.task, resources=replace(resources, memory_bytes=increased))
        return f"it asks for {data_size(increased)} now"

    def _end(self, state: _TaskState, end: EndState, reason: str = "", was_killed: bool = False) -> None:
        task = state.task
        seconds = time.monotonic() - state.start_time if state.attempts and state.start_time else 0.0
        lines = tuple(tail_lines(task.output, state.output_from)) if end == "failed" and state.started else ()
        state.result = TaskResult(
            name=task.name, state=end, attempts=state.attempts, seconds=seconds, reason=reason, was_killed=was_killed,
            last_lines=lines,
        )  # fmt: skip
        self._listener.on_ended(task, state.result)


def stop_message(results: Iterable[TaskResult], what: str) -> str:
    """What to say where tasks were asked to stop: that `what` ran is saved, or which of it was ended before it was."""
    killed = ", ".join(result.name for result in results if result.was_killed)
    said = (
        f"ended before it could save: {killed}. What is kept is the last checkpoint" if killed else f"{what} is saved"
    )
    return f"Stopped; {said}. The same command continues."


def stage_iteration(folder: Path | None) -> int:
    """The iteration in the status file of a stage folder; 0 where there is none."""
    try:
        return 0 if folder is None else StageFolder(folder).status().iteration or 0
    except (VdgsError, OSError):
        return 0


def _end_text(end: AttemptResult) -> str:
    if end.code is None:
        return end.reason
    if end.code >= 0:
        return f"exit code {end.code}"
    try:
        return signal.Signals(-end.code).name
    except ValueError:
        return f"signal {-end.code}"


def _start_error_text(task: Task, error: OSError) -> str:
    return (
        f"{error.filename or task.output}: {error.strerror or error}. Free some space or mend the folder, "
        "then run the same command again."
    )


def _silent_failure_text(task: Task, end: str) -> str:
    """The reason of a failure without a message."""
    folder = task.output.parent
    if is_disk_full(folder):
        return f"{folder}: the disk is full. Free some space, then run the same command again."
    return f"{end}, without a message"
