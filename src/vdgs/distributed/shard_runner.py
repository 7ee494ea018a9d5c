"""Pieces of work as tasks of an executor: what their status files say while they run, shown live; how they ended."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from rich.console import Console

from vdgs.distributed.executor import Executor, Lines, Needs, Outcome, Task
from vdgs.distributed.job_labels import BLOCKS, Kind
from vdgs.distributed.progress_table import STYLES, Board
from vdgs.distributed.shard_progress import PieceProgress, read_figures
from vdgs.errors import VdgsError
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.units import clock


@dataclass(frozen=True)
class Piece:
    """A command that does one piece of work, such as training a block: it continues after an interruption, and does
    nothing once it is done."""

    index: int
    folder: StageFolder
    """The command locks it and keeps its status file; its output is appended to `output.log` there."""
    command: list[str]
    needs: Needs = field(default_factory=Needs)
    kind: Kind = BLOCKS

    @property
    def name(self) -> str:
        return f"{self.kind.one} {self.index:02d}"

    @property
    def output(self) -> Path:
        return self.folder.path / "output.log"

    def task(self) -> Task:
        return Task(name=self.name, command=self.command, output=self.output, folder=self.folder.path, needs=self.needs)


def default_jobs(pieces: int, cores: int, memory_available: int, memory_each: int) -> tuple[int, int]:
    """How many pieces to do at once on the CPU, and with how many threads each (choice).

    As many as there are cores and memory (bytes) for, at least one: separate ones use cores better than the threads of
    one. The cores left over are shared out.
    """
    fit = memory_available // memory_each if memory_each > 0 else pieces
    jobs = max(1, min(pieces, cores, fit))
    return jobs, max(1, cores // jobs)


def run_pieces(pieces: Sequence[Piece], executor: Executor, console: Console) -> list[Outcome]:
    """Run the command of every piece, with a live table; the outcomes in their order. One that fails stops no other."""
    rows = [PieceProgress(piece.index) for piece in pieces]
    for piece, row in zip(pieces, rows, strict=True):
        row.observe(read_figures(piece.folder.status_file), time.monotonic())
    kind = pieces[0].kind if pieces else BLOCKS
    with Board(console, rows, executor.at_once, kind) as board:
        outcomes = executor.run([piece.task() for piece in pieces], _Watcher(pieces, rows, board))
    _summarise(pieces, kind, outcomes, console)
    return outcomes


class _Watcher(Lines):
    """Keeps the rows of the table as status files say."""

    def __init__(self, pieces: Sequence[Piece], rows: Sequence[PieceProgress], board: Board):
        super().__init__(board.say)
        self._board = board
        self._pairs = {piece.name: (piece, row) for piece, row in zip(pieces, rows, strict=True)}
        #: On which machine, in words, where it is not this one.
        self._where = dict[str, str]()

    def placed(self, task: Task, where: str, found: bool) -> None:
        self._where[task.name] = f" on {where}"
        if found:
            self.say(f"{task.name}: is still at work on {where}, and is watched again", "")

    def started(self, task: Task, attempt: int) -> None:
        self._pairs[task.name][1].started()
        self._board.note(f"{task.name}: started{self._where.get(task.name, '')}{_attempt(attempt)}")

    def paused(self, task: Task, why: str) -> None:
        super().paused(task, why)
        self._observe(task.name)
        self._pairs[task.name][1].state = "queued"

    def crashed(self, task: Task, how: str, attempts_left: int) -> None:
        super().crashed(task, how, attempts_left)
        self._observe(task.name)
        self._pairs[task.name][1].state = "queued"

    def ended(self, task: Task, outcome: Outcome) -> None:
        piece, row = self._pairs[task.name]
        self._observe(task.name)
        row.state, row.attempts = outcome.state, outcome.attempts
        if outcome.state == "failed":
            self.say(f"{task.name}: failed", STYLES[outcome.state])
            self.say("\n".join(f"  {line}" for line in outcome.last_lines or outcome.why.splitlines()), "")
        elif outcome.attempts:
            took = f"{clock(outcome.seconds)}{_attempt(outcome.attempts)}"
            self._board.note(f"{task.name}: {outcome.state} after {took}")
        if outcome.attempts and outcome.state != "done":
            _note_end(piece.folder, outcome)

    def tick(self) -> None:
        for name in self._pairs:
            self._observe(name)
        self._board.show()

    def _observe(self, name: str) -> None:
        piece, row = self._pairs[name]
        if row.state == "running":
            row.observe(read_figures(piece.folder.status_file), time.monotonic())


def _attempt(number: int) -> str:
    return f" (attempt {number})" if number > 1 else ""


def _note_end(folder: StageFolder, outcome: Outcome) -> None:
    """Let no status file say "running" of a piece that is not: a process that was killed could not write it itself."""
    # Not if another process has taken over, nor if the file is damaged.
    with suppress(VdgsError, OSError, ValueError), folder.locked():
        status = folder.status()
        if status.state not in (outcome.state, "done"):
            folder.set_status(replace(status, state=outcome.state, why=outcome.why))


def _summarise(pieces: Sequence[Piece], kind: Kind, outcomes: list[Outcome], console: Console) -> None:
    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, highlight=False, markup=False)

    unfinished = [(piece, outcome) for piece, outcome in zip(pieces, outcomes, strict=True) if outcome.state != "done"]
    say(f"{len(pieces) - len(unfinished)} of {len(pieces)} {kind.many} done")
    for piece, outcome in unfinished:
        if outcome.attempts:
            say(f"{piece.name} {outcome.state}" + (f": {outcome.why}" if outcome.why else ""), STYLES[outcome.state])
        if outcome.state == "failed" and piece.output.is_file():
            say(f"  all of its output: {piece.output}")
    if waited := [piece.name for piece, outcome in unfinished if not outcome.attempts]:
        say(f"not started: {', '.join(waited)}", STYLES["stopped"])
    if unfinished:
        say(f"The same command continues these {kind.many} and leaves those that are done.")
