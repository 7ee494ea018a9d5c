"""Pieces of work as tasks of an executor: what their status files say while they run, shown live; how they ended."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console

from vdgs.distributed.executor import Executor, LogListener, Task, TaskResources, TaskResult
from vdgs.distributed.job_labels import BLOCK_LABELS, JobLabels
from vdgs.distributed.progress_table import STATE_STYLES, ProgressTable
from vdgs.distributed.shard_progress import ShardProgress, read_progress_stats
from vdgs.errors import VdgsError
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.units import clock


@dataclass(frozen=True)
class Shard:
    """A command that does one piece of work, such as training a block: it continues after an interruption, and does
    nothing once it is done."""

    index: int
    folder: StageFolder
    """The command locks it and keeps its status file; its output is appended to `output.log` there."""
    command: list[str]
    resources: TaskResources = field(default_factory=TaskResources)
    labels: JobLabels = BLOCK_LABELS

    @property
    def name(self) -> str:
        return f"{self.labels.singular} {self.index:02d}"

    @property
    def output(self) -> Path:
        return self.folder.path / "output.log"

    def task(self) -> Task:
        return Task(
            name=self.name, command=self.command, output=self.output, folder=self.folder.path, resources=self.resources
        )


def default_jobs(shards: int, cores: int, memory_available: int, memory_each: int) -> tuple[int, int]:
    """How many pieces to do at once on the CPU, and with how many threads each (choice).

    As many as there are cores and memory (bytes) for, at least one: separate ones use cores better than the threads of
    one. The cores left over are shared out.
    """
    fit = memory_available // memory_each if memory_each > 0 else shards
    jobs = max(1, min(shards, cores, fit))
    return jobs, max(1, cores // jobs)


def run_shards(shards: Sequence[Shard], executor: Executor, console: Console) -> list[TaskResult]:
    """Run the command of every piece, with a live table; the outcomes in their order. One that fails stops no other."""
    rows = [ShardProgress(piece.index) for piece in shards]
    for piece, row in zip(shards, rows, strict=True):
        row.observe(read_progress_stats(piece.folder.status_file), time.monotonic())
    kind = shards[0].labels if shards else BLOCK_LABELS
    with ProgressTable(console, rows, executor.max_concurrent, kind) as board:
        outcomes = executor.run([piece.task() for piece in shards], _ProgressListener(shards, rows, board))
    _print_summary(shards, kind, outcomes, console)
    return outcomes


class _ProgressListener(LogListener):
    """Keeps the rows of the table as status files say."""

    def __init__(self, pieces: Sequence[Shard], rows: Sequence[ShardProgress], board: ProgressTable):
        super().__init__(board.print_line)
        self._board = board
        self._pairs = {piece.name: (piece, row) for piece, row in zip(pieces, rows, strict=True)}
        #: On which machine, in words, where it is not this one.
        self._where = dict[str, str]()

    def placed(self, task: Task, where: str, found: bool) -> None:
        self._where[task.name] = f" on {where}"
        if found:
            self.print_line(f"{task.name}: is still at work on {where}, and is watched again", "")

    def started(self, task: Task, attempt: int) -> None:
        self._pairs[task.name][1].restart()
        self._board.note(f"{task.name}: started{self._where.get(task.name, '')}{_attempt_text(attempt)}")

    def paused(self, task: Task, why: str) -> None:
        super().paused(task, why)
        self._observe(task.name)
        self._pairs[task.name][1].state = "queued"

    def crashed(self, task: Task, how: str, attempts_left: int) -> None:
        super().crashed(task, how, attempts_left)
        self._observe(task.name)
        self._pairs[task.name][1].state = "queued"

    def ended(self, task: Task, outcome: TaskResult) -> None:
        piece, row = self._pairs[task.name]
        self._observe(task.name)
        row.state, row.attempts = outcome.state, outcome.attempts
        if outcome.state == "failed":
            self.print_line(f"{task.name}: failed", STATE_STYLES[outcome.state])
            self.print_line("\n".join(f"  {line}" for line in outcome.last_lines or outcome.reason.splitlines()), "")
        elif outcome.attempts:
            took = f"{clock(outcome.seconds)}{_attempt_text(outcome.attempts)}"
            self._board.note(f"{task.name}: {outcome.state} after {took}")
        if outcome.attempts and outcome.state != "done":
            _record_end(piece.folder, outcome)

    def tick(self) -> None:
        for name in self._pairs:
            self._observe(name)
        self._board.show()

    def _observe(self, name: str) -> None:
        piece, row = self._pairs[name]
        if row.state == "running":
            row.observe(read_progress_stats(piece.folder.status_file), time.monotonic())


def _attempt_text(number: int) -> str:
    return f" (attempt {number})" if number > 1 else ""


def _record_end(folder: StageFolder, outcome: TaskResult) -> None:
    """Let no status file say "running" of a piece that is not: a process that was killed could not write it itself."""
    # Not if another process has taken over, nor if the file is damaged.
    with suppress(VdgsError, OSError, ValueError), folder.locked():
        status = folder.status()
        if status.state not in (outcome.state, "done"):
            folder.set_status(replace(status, state=outcome.state, reason=outcome.reason))


def _print_summary(shards: Sequence[Shard], labels: JobLabels, outcomes: list[TaskResult], console: Console) -> None:
    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, markup=False)

    unfinished = [(piece, outcome) for piece, outcome in zip(shards, outcomes, strict=True) if outcome.state != "done"]
    say(f"{len(shards) - len(unfinished)} of {len(shards)} {labels.plural} done")
    for piece, outcome in unfinished:
        if outcome.attempts:
            say(
                f"{piece.name} {outcome.state}" + (f": {outcome.reason}" if outcome.reason else ""),
                STATE_STYLES[outcome.state],
            )
        if outcome.state == "failed" and piece.output.is_file():
            say(f"  all of its output: {piece.output}")
    if waited := [piece.name for piece, outcome in unfinished if not outcome.attempts]:
        say(f"not started: {', '.join(waited)}", STATE_STYLES["stopped"])
    if unfinished:
        say(f"The same command continues these {labels.plural} and leaves those that are done.")
