"""The shards of a job as tasks of an executor: their status files are shown live, and how they ended."""

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
class ShardCommand:
    """A command that does one shard, such as training a block: it continues after an interruption, and does nothing
    once it is done."""

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


def run_shards(shards: Sequence[ShardCommand], executor: Executor, console: Console) -> list[TaskResult]:
    """Run every shard, with a live table; the results in their order. One that fails stops no other."""
    rows = [ShardProgress(shard.index) for shard in shards]
    for shard, row in zip(shards, rows, strict=True):
        row.observe(read_progress_stats(shard.folder.status_file), time.monotonic())
    labels = shards[0].labels if shards else BLOCK_LABELS
    with ProgressTable(console, rows, executor.max_concurrent, labels) as table:
        results = executor.run([shard.task() for shard in shards], _ProgressListener(shards, rows, table))
    _print_summary(shards, labels, results, console)
    return results


class _ProgressListener(LogListener):
    """Keeps the rows of the table as status files say."""

    def __init__(self, shards: Sequence[ShardCommand], rows: Sequence[ShardProgress], table: ProgressTable):
        super().__init__(table.print_line)
        self._table = table
        self._shards = {shard.name: (shard, row) for shard, row in zip(shards, rows, strict=True)}
        #: On which machine each runs, in words, where it is not this one.
        self._where = dict[str, str]()

    def on_placed(self, task: Task, where: str, resumed: bool) -> None:
        self._where[task.name] = f" on {where}"
        if resumed:
            self.print_line(f"{task.name}: is still at work on {where}, and is watched again", "")

    def on_started(self, task: Task, attempt: int) -> None:
        self._shards[task.name][1].restart()
        self._table.note(f"{task.name}: started{self._where.get(task.name, '')}{_attempt_text(attempt)}")

    def on_paused(self, task: Task, why: str) -> None:
        super().on_paused(task, why)
        self._requeue(task)

    def on_crashed(self, task: Task, how: str, attempts_left: int) -> None:
        super().on_crashed(task, how, attempts_left)
        self._requeue(task)

    def on_ended(self, task: Task, result: TaskResult) -> None:
        shard, row = self._shards[task.name]
        self._observe(task.name)
        row.state, row.attempts = result.state, result.attempts
        if result.state == "failed":
            self.print_line(f"{task.name}: failed", STATE_STYLES[result.state])
            self.print_line("\n".join(f"  {line}" for line in result.last_lines or result.reason.splitlines()), "")
        elif result.attempts:
            took = f"{clock(result.seconds)}{_attempt_text(result.attempts)}"
            self._table.note(f"{task.name}: {result.state} after {took}")
        if result.attempts and result.state != "done":
            _record_end(shard.folder, result)

    def on_tick(self) -> None:
        for name in self._shards:
            self._observe(name)
        self._table.show()

    def _requeue(self, task: Task) -> None:
        self._observe(task.name)
        self._shards[task.name][1].state = "queued"

    def _observe(self, name: str) -> None:
        shard, row = self._shards[name]
        if row.state == "running":
            row.observe(read_progress_stats(shard.folder.status_file), time.monotonic())


def _attempt_text(number: int) -> str:
    return f" (attempt {number})" if number > 1 else ""


def _record_end(folder: StageFolder, result: TaskResult) -> None:
    """Let no status file say "running" of a shard that is not: a process that was killed could not write it itself."""
    # Not if another process has taken over, nor if the file is damaged.
    with suppress(VdgsError, OSError, ValueError), folder.locked():
        status = folder.status()
        if status.state not in (result.state, "done"):
            folder.set_status(replace(status, state=result.state, reason=result.reason))


def _print_summary(
    shards: Sequence[ShardCommand], labels: JobLabels, results: list[TaskResult], console: Console
) -> None:
    def print_line(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, markup=False)

    unfinished = [(shard, result) for shard, result in zip(shards, results, strict=True) if result.state != "done"]
    print_line(f"{len(shards) - len(unfinished)} of {len(shards)} {labels.plural} done")
    for shard, result in unfinished:
        if result.attempts:
            reason = f": {result.reason}" if result.reason else ""
            print_line(f"{shard.name} {result.state}{reason}", STATE_STYLES[result.state])
        if result.state == "failed" and shard.output.is_file():
            print_line(f"  all of its output: {shard.output}")
    if not_started := [shard.name for shard, result in unfinished if not result.attempts]:
        print_line(f"not started: {', '.join(not_started)}", STATE_STYLES["stopped"])
    if unfinished:
        print_line(f"The same command continues these {labels.plural} and leaves those that are done.")
