"""Runs jobs side by side in processes of this machine, each continued from its own state if it crashes.

A job that ends with 0 is done; with 1 or 2 (usage) it failed for a reason that it printed, which another attempt would
not mend; with 130 it was asked to stop. Everything else, and every signal, is a crash: the job is started again.
Each job has a session of its own, so that the terminal's Ctrl-C reaches this process alone, which passes it on once.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from rich.console import Console

from vdgs.errors import RunError, VdgsError
from vdgs.executors.jobs import Job, JobProgress, Outcome, read_figures
from vdgs.executors.output import explanation, last_lines
from vdgs.executors.parent import PARENT
from vdgs.executors.table import STYLES, Board, duration

#: Exit codes of the command line (cli.py).
DONE, EXPLAINED, STOPPED = 0, (1, 2), 130
#: Seconds that jobs get to save when this process fails itself.
GRACE_SECONDS = 60.0
#: Free bytes below which a silent failure is put down to a full disk.
FULL_BYTES = 1 << 20
#: Seconds to wait for a process that still holds a job's folder, such as one whose driver was killed and that saves.
PATIENCE_SECONDS = 60.0


def default_jobs(blocks: int, cores: int, memory_available: int, memory_per_block: int) -> tuple[int, int]:
    """How many blocks to train at once on the CPU, and with how many threads each (choice).

    As many blocks as there are cores and memory (bytes) for, at least one: separate blocks use cores better than the
    threads of one block. The cores left over are shared out.
    """
    fit = memory_available // memory_per_block if memory_per_block > 0 else blocks
    jobs = max(1, min(blocks, cores, fit))
    return jobs, max(1, cores // jobs)


def run_jobs(
    jobs: Sequence[Job], *, at_once: int, retries: int = 2, console: Console, poll_seconds: float = 0.5
) -> list[Outcome]:
    """Run every job, at most `at_once` at a time, each again up to `retries` times if it crashes.

    Outcomes come in the order of the jobs; one that fails stops no other. On Ctrl-C, SIGTERM or SIGHUP the running
    jobs are asked once to save and end, and no more are started; a second Ctrl-C kills them.
    """
    if at_once < 1 or retries < 0:
        raise ValueError(f"at_once is {at_once} and retries is {retries}: at least 1 and 0 are needed")
    rows = [JobProgress(job.index) for job in jobs]
    for job, row in zip(jobs, rows, strict=True):
        row.observe(read_figures(job.folder.status_file), time.monotonic())
    with _stop_requests() as asked, Board(console, rows, at_once) as board:
        crew = _Crew([_Work(job, row) for job, row in zip(jobs, rows, strict=True)], at_once, retries, board)
        try:
            while not crew.step(asked):
                time.sleep(poll_seconds)
        finally:
            crew.abandon()
    outcomes = [work.outcome for work in crew.works if work.outcome is not None]
    _summarise(jobs, outcomes, console)
    return outcomes


class _Work:
    """A job and the process that does it."""

    def __init__(self, job: Job, row: JobProgress):
        self.job, self.row = job, row
        self.process: subprocess.Popen[bytes] | None = None
        self.outcome: Outcome | None = None
        self.asked_to_stop = False
        #: Where the output of this attempt begins, and when it did.
        self.output_from, self.began = 0, 0.0
        #: Since when another process is seen to work on it.
        self.held_since: float | None = None

    def start(self) -> None:
        """Start the command. Raises OSError if its folder cannot be written or there is no such command."""
        self.row.started()
        self.began = time.monotonic()
        self.job.folder.path.mkdir(parents=True, exist_ok=True)
        heading = (
            f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} attempt {self.row.attempts}: {shlex.join(self.job.command)}"
        )
        variables = {"PYTHONUNBUFFERED": "1", **self.job.environment, PARENT: str(os.getpid())}
        with self.job.output.open("ab") as output:
            output.write(f"{heading}\n".encode())
            output.flush()
            self.output_from = output.tell()
            self.process = subprocess.Popen(
                self.job.command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
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
    """The jobs of one call: which wait, which run, how each ended."""

    def __init__(self, works: list[_Work], at_once: int, retries: int, board: Board):
        self.works, self._at_once, self._retries, self._board = works, at_once, retries, board
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
            work.row.observe(read_figures(work.job.folder.status_file), time.monotonic())
            if code is not None:
                work.process = None
                self._judge(work, code)
        if asked:
            self._stop(kill=signal.SIGINT in asked[1:])
        for work in list(self._waiting):
            if len(self._running) < self._at_once and not self._held(work):
                self._waiting.remove(work)
                self._start(work)
        self._board.show()
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
        """Another process still works on the job, and patience is not at an end (then the job says so itself)."""
        try:
            with work.job.folder.locked():
                return False
        except RunError as error:
            if not isinstance(error.__cause__, BlockingIOError):
                return False  # the folder cannot be written: starting says why
        if work.held_since is None:
            work.held_since = time.monotonic()
            self._board.say(f"{work.job.name}: waiting for another process that works on it", "yellow")
        return time.monotonic() - work.held_since < PATIENCE_SECONDS

    def _start(self, work: _Work) -> None:
        try:
            work.start()
        except OSError as error:
            why = (
                f"{error.filename or work.job.output}: {error.strerror or error}. Free some space or mend the folder, "
                "then run the same command again."
            )
            self._end(work, "failed", why)
        else:
            self._board.note(f"{work.job.name}: started" + self._attempt(work))

    def _stop(self, kill: bool) -> None:
        if not self._stopping:
            self._stopping = True
            while self._waiting:
                self._end(self._waiting.popleft(), "stopped", "not started")
            if self._running:
                names = ", ".join(work.job.name for work in self._running)
                self._board.say(f"stopping: {names} will save and end (Ctrl-C again kills)", "yellow")
        for work in self._running:
            work.ask_to_stop()
            if kill:
                work.kill()

    def _judge(self, work: _Work, code: int) -> None:
        why = explanation(work.job.output, work.output_from)
        if code == DONE:
            self._end(work, "done")
        elif code == STOPPED:
            self._end(work, "stopped", why if work.asked_to_stop else f"stopped by someone else. {why}".strip())
        elif code in EXPLAINED:
            self._end(work, "failed", why or _without_words(work.job, code))
        elif self._stopping:
            self._end(work, "stopped", f"ended by {_name(code)}; continues from its last saved state")
        else:
            self._crashed(work, code, why)

    def _crashed(self, work: _Work, code: int, why: str) -> None:
        name = _name(code)
        if code == -signal.SIGKILL:
            name += self._fewer_if_out_of_memory()
        if work.row.attempts > self._retries:
            end = f"crashed {work.row.attempts} times, at last by {name}" if self._retries else f"crashed by {name}"
            self._end(work, "failed", f"{end}. {why}".strip())
            return
        more = self._retries + 1 - work.row.attempts
        text = f"{work.job.name}: crashed by {name}; continues from its last saved state, attempts left: {more}"
        self._board.say(text, "yellow")
        work.row.state = "queued"
        self._waiting.append(work)

    def _fewer_if_out_of_memory(self) -> str:
        """Train fewer at once if the system has ended processes for want of memory; what to say of it."""
        kills, before = out_of_memory_kills(), self._memory_kills
        self._memory_kills = kills
        if kills <= before:
            return ""
        self._at_once = max(1, self._at_once - 1)
        return f" (out of memory; from now on at most {self._at_once} at once)"

    def _end(self, work: _Work, state: Literal["done", "failed", "stopped"], why: str = "") -> None:
        job, row = work.job, work.row
        row.state = state
        work.outcome = Outcome(job.index, state, row.attempts, why)
        if state == "failed":
            self._board.say(f"{job.name}: failed", STYLES[state])
            lines = last_lines(job.output, work.output_from) or why.splitlines()
            self._board.say("\n".join(f"  {line}" for line in lines))
        elif row.attempts:
            self._board.note(
                f"{job.name}: {state} after {duration(time.monotonic() - work.began)}{self._attempt(work)}"
            )
        if row.attempts and state != "done":
            _record(job, state, why)

    @staticmethod
    def _attempt(work: _Work) -> str:
        return f" (attempt {work.row.attempts})" if work.row.attempts > 1 else ""


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


def _without_words(job: Job, code: int) -> str:
    """What to say of a job that failed and printed nothing."""
    with suppress(OSError):
        if shutil.disk_usage(job.folder.path).free < FULL_BYTES:
            return f"{job.folder.path}: the disk is full. Free some space, then run the same command again."
    return f"{_name(code)}, without a message"


def _record(job: Job, state: str, why: str) -> None:
    """Let no status file say "running" of a job that is not: one that was killed could not write it itself."""
    folder = job.folder
    # Not if another process has taken over, nor if the file is damaged.
    with suppress(VdgsError, OSError, ValueError), folder.locked():
        status = folder.status()
        if status["state"] not in (state, "done"):
            facts = {name: fact for name, fact in status.items() if name not in ("state", "why")}
            folder.set_status(state, **facts, why=why)


def _summarise(jobs: Sequence[Job], outcomes: list[Outcome], console: Console) -> None:
    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, markup=False)

    unfinished = [(job, outcome) for job, outcome in zip(jobs, outcomes, strict=True) if outcome.state != "done"]
    say(f"{len(jobs) - len(unfinished)} of {len(jobs)} blocks done")
    for job, outcome in unfinished:
        if outcome.attempts:
            say(f"{job.name} {outcome.state}" + (f": {outcome.why}" if outcome.why else ""), STYLES[outcome.state])
        if outcome.state == "failed" and job.output.is_file():
            say(f"  all of its output: {job.output}")
    if waited := [job.name for job, outcome in unfinished if not outcome.attempts]:
        say(f"not started: {', '.join(waited)}", STYLES["stopped"])
    if unfinished:
        say("The same command continues these blocks and leaves those that are done.")


@contextmanager
def _stop_requests() -> Iterator[list[int]]:
    """The signals that asked to stop, in their order. Elsewhere than in the main thread Python allows no handlers."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup means it
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, lambda number, _frame: asked.append(number)) for number in numbers}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
