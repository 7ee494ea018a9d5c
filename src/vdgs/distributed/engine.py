"""What a crew asks of an engine: to begin attempts at tasks, somewhere, and to say what becomes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from vdgs.distributed.executor import Task

#: Exit codes of the command line (cli.py).
DONE, EXPLAINED, STOPPED = 0, (1, 2), 130


@dataclass(frozen=True)
class Begun:
    """Where an attempt runs, and where its part of the output begins."""

    output_from: int = 0
    where: str = ""
    """Empty on this machine."""


@dataclass(frozen=True)
class End:
    """How an attempt ended."""

    code: int | None
    """The exit code as `subprocess` counts (negative: a signal); None of one that was lost with its place."""
    how: str = ""
    """Of a lost one: by what, in words."""
    out_of_memory: bool = False
    """The system, or the cluster, ended it for want of memory."""
    out_of_time: bool = False
    """It was asked to save because its time was up or its place was needed, and did."""


class Attempt(Protocol):
    """An attempt at a task, wherever its process is."""

    @property
    def begun(self) -> Begun | None:
        """None while it waits for a place, or waits for one again."""

    def look(self) -> End | None:
        """How it ended; None while it goes on. Brings `begun` up to date."""

    def ask_to_stop(self) -> None:
        """Ask it to save and end; one that waits for a place ends at once. Called once."""

    def kill(self) -> None:
        """End it, and whatever it started, at once."""


class Engine(Protocol):
    """Begins attempts."""

    @property
    def most_memory(self) -> int | None:
        """Bytes that a task can ask for at most; None of an engine that finds no place by needs."""

    def start(self, tasks: Sequence[tuple[Task, int]]) -> Sequence[Attempt | OSError]:
        """Begin an attempt (of that number) at each task, or say what the system refuses."""

    def find(self, task: Task) -> Attempt | None:
        """An attempt that a driver began which died since, and that goes on without it."""

    def refresh(self) -> None:
        """Learn the news that `look` tells; once before all looks."""
