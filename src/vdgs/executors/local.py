"""Tasks as processes of this machine, side by side, each continued from its own state if it crashes.

Each has a session of its own, so that the terminal's Ctrl-C reaches this process alone, which passes it on once.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vdgs.executors.executor import EndState, Listener, Outcome, Task
from vdgs.executors.output import explanation, last_lines
from vdgs.executors.parent import PARENT
from vdgs.runs.folder import StageFolder
from vdgs.watching.interrupts import stop_requests

#: Exit codes of the command line (cli.py).
DONE, EXPLAINED, STOPPED = 0, (1, 2), 130
#: Seconds that tasks get to save when this process fails itself.
GRACE_SECONDS = 120.0
#: Free bytes below which a silent failure is put down to a full disk.
FULL_BYTES = 1 << 20
#: Seconds to wait for a process that still holds a task's folder, such as one whose driver was killed and that saves.
PATIENCE_SECONDS = 60.0


@dataclass(frozen=True)
class LocalExecutor:
    """Runs tasks in processes of this machine. A second Ctrl-C kills those that still run."""

    at_once: int
    retries: int = 2
    """How often a task that crashes is started again."""
    poll_seconds: float = 0.5

    def __post_init__(self) -> None:
        if self.at_once < 1 or self.retries < 0:
            raise ValueError(f"at_once is {self.at_once} and retries is {self.retries}: at least 1 and 0 are needed")

    def run(self, tasks: Sequence[Task], listener: Listener) -> list[Outcome]:
        """As `Executor.run`."""
        with stop_requests(hangup=True) as asked:
            crew = _Crew([_Work(task) for task in tasks], self, listener)
            try:
                while not crew.step(asked):
                    time.sleep(self.poll_seconds)
            finally:
                crew.abandon()
        return [work.outcome for work in crew.works if work.outcome is not None]


class _Work:
    """A task and the process that does it."""

    def __init__(self, task: Task):
        self.task = task
        self.process: subprocess.Popen[bytes] | None = None
        self.outcome: Outcome | None = None
        self.attempts = 0
        self.asked_to_stop = False
        #: Where the output of this attempt begins, and when it did.
        self.output_from, self.began = 0, 0.0
        #: Since when another process is seen to work on it.
        self.held_since: float | None = None

    def start(self) -> None:
        """Start the command. Raises OSError if its output cannot be written or there is no such command."""
        task = self.task
        self.attempts += 1
        self.began = time.monotonic()
        task.output.parent.mkdir(parents=True, exist_ok=True)
        heading = f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} attempt {self.attempts}: {shlex.join(task.command)}"
        variables = {"PYTHONUNBUFFERED": "1", **task.environment, PARENT: str(os.getpid())}
        with task.output.open("ab") as output:
            output.write(f"{heading}\n".encode())
            output.flush()
            self.output_from = output.tell()
            self.process = subprocess.Popen(
                task.command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
                env={**os.environ, **variables}, start_new_session=True,
            )  # fmt: skip

    def ask_to_stop(self) -> None:
        if self.process is not None and not self.asked_to_stop:
            self.asked_to_stop = True
            self.process.terminate()

    def kill(self) -> None:
        """End the process and whatever it started (its session's group)."""
        if self.process is not None and self.process.poll() is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)


class _Crew:
    """The tasks of one call: which wait, which run, how each ended."""

    def __init__(self, works: list[_Work], executor: LocalExecutor, listener: Listener):
        self.works, self._at_once, self._retries = works, executor.at_once, executor.retries
        self._listener = listener
        self._by_name = {work.task.name: work for work in works}
        self._waiting = deque(works)
        self._stopping = False
        self._memory_kills = out_of_memory_kills()

    @property
    def _running(self) -> list[_Work]:
        return [work for work in self.works if work.process is not None]

    def step(self, asked: Sequence[int]) -> bool:
        """Judge what ended, pass on what was `asked` (signals), start what there is room for. True when all ended."""
        for work in self._running:
            assert work.process is not None
            code = work.process.poll()
            if code is not None:
                work.process = None
                self._judge(work, code)
        if asked:
            self._stop(kill=signal.SIGINT in asked[1:])
        for work in list(self._waiting):
            before = self._by_name.get(work.task.after) if work.task.after is not None else None
            end = before.outcome if before is not None else None
            if end is not None and end.state != "done":
                self._waiting.remove(work)
                self._end(work, end.state, f"{end.name} {end.state}: {end.why}")
            elif len(self._running) < self._at_once and (before is None or end is not None) and not self._held(work):
                self._waiting.remove(work)
                self._start(work)
        self._listener.tick()
        return not self._waiting and not self._running

    def abandon(self) -> None:
        """Leave no process behind when this one fails itself."""
        for work in self._running:
            work.ask_to_stop()
        end = time.monotonic() + GRACE_SECONDS
        for work in self._running:
            assert work.process is not None
            with suppress(subprocess.TimeoutExpired):
                work.process.wait(max(0.0, end - time.monotonic()))
            work.kill()

    def _held(self, work: _Work) -> bool:
        """Another process still works on the task, and patience is not at an end (then the task says so itself)."""
        if work.task.folder is None or not StageFolder(work.task.folder).is_held():
            return False
        if work.held_since is None:
            work.held_since = time.monotonic()
            self._listener.waits(work.task)
        return time.monotonic() - work.held_since < PATIENCE_SECONDS

    def _start(self, work: _Work) -> None:
        try:
            work.start()
        except OSError as error:
            why = (
                f"{error.filename or work.task.output}: {error.strerror or error}. Free some space or mend the folder, "
                "then run the same command again."
            )
            self._end(work, "failed", why)
        else:
            self._listener.started(work.task, work.attempts)

    def _stop(self, kill: bool) -> None:
        if not self._stopping:
            self._stopping = True
            while self._waiting:
                self._end(self._waiting.popleft(), "stopped", "not started")
            if self._running:
                self._listener.stopping([work.task for work in self._running])
        for work in self._running:
            work.ask_to_stop()
            if kill:
                work.kill()

    def _judge(self, work: _Work, code: int) -> None:
        why = explanation(work.task.output, work.output_from)
        if code == DONE:
            self._end(work, "done")
        elif code == STOPPED:
            self._end(work, "stopped", why if work.asked_to_stop else f"stopped by someone else. {why}".strip())
        elif code in EXPLAINED:
            self._end(work, "failed", why or _without_words(work.task, code))
        elif self._stopping:
            self._end(work, "stopped", f"ended by {_name(code)}; continues from its last checkpoint")
        else:
            self._crashed(work, code, why)

    def _crashed(self, work: _Work, code: int, why: str) -> None:
        how = _name(code)
        if code == -signal.SIGKILL:
            how += self._fewer_if_out_of_memory()
        if work.attempts > self._retries:
            end = f"crashed {work.attempts} times, at last by {how}" if self._retries else f"crashed by {how}"
            self._end(work, "failed", f"{end}. {why}".strip())
            return
        self._listener.crashed(work.task, how, self._retries + 1 - work.attempts)
        self._waiting.append(work)

    def _fewer_if_out_of_memory(self) -> str:
        """Run fewer at once if the system has ended processes for want of memory; what to say of it."""
        kills, before = out_of_memory_kills(), self._memory_kills
        self._memory_kills = kills
        if kills <= before:
            return ""
        self._at_once = max(1, self._at_once - 1)
        return f" (out of memory; from now on at most {self._at_once} at once)"

    def _end(self, work: _Work, state: EndState, why: str = "") -> None:
        seconds = time.monotonic() - work.began if work.attempts else 0.0
        lines = tuple(last_lines(work.task.output, work.output_from)) if state == "failed" and work.attempts else ()
        work.outcome = Outcome(work.task.name, state, work.attempts, seconds, why, lines)
        self._listener.ended(work.task, work.outcome)


def out_of_memory_kills() -> int:
    """How many processes the system has ended so far for want of memory; 0 where it does not say."""
    try:
        counters = Path("/proc/vmstat").read_text(encoding="ascii")
    except (OSError, ValueError):
        return 0
    return next((int(line.split()[1]) for line in counters.splitlines() if line.startswith("oom_kill ")), 0)


def _name(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"


def _without_words(task: Task, code: int) -> str:
    """What to say of a task that failed and printed nothing."""
    folder = task.output.parent
    with suppress(OSError):
        if shutil.disk_usage(folder).free < FULL_BYTES:
            return f"{folder}: the disk is full. Free some space, then run the same command again."
    return f"{_name(code)}, without a message"
