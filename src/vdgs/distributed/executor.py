"""The interface of what runs tasks: processes of this machine (`local_executor`), Ray (`ray_executor`), SLURM
(`slurm_executor`).

A task is a command that can be repeated: it continues after an interruption and does nothing once it is done. So an
executor keeps no state of its own, and may die. A task that ends with 0 is done; with 1 or 2 (usage) it failed for a
reason that it printed, which another attempt would not mend; with 130 it was asked to stop. Everything else is a crash:
the task is started again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

#: How a task can end.
EndState = Literal["done", "failed", "stopped"]
#: Exit codes of the command line (`system.exit_codes`).
EXIT_DONE, EXIT_EXPLAINED, EXIT_STOPPED = 0, (1, 2), 130
#: Environment variable with the process id of the driver; set for each task that a driver starts.
PARENT_PID_VARIABLE = "VDGS_PARENT"


@dataclass(frozen=True)
class TaskResources:
    """What a task asks of the machine where it runs. Processes of this machine take what there is."""

    cpus: int = 1
    memory_bytes: int = 0
    """0: not stated."""
    gpus: float = 0.0
    """Fractions are possible where the executor knows them."""
    device: str = ""
    """The card of this machine that it computes on, where there is a choice of them."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A command that can be repeated."""

    name: str
    command: Sequence[str]
    output: Path
    """What it prints is appended here."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables on top of those of this process."""
    folder: Path | None = None
    """The stage folder that the command locks while it works; while another process holds it, the task waits."""
    after: str | None = None
    """The name of the task, among those run with it, that must be done before this one starts."""
    resources: TaskResources = field(default_factory=TaskResources)

    def remote_environment(self) -> dict[str, str]:
        """Its variables on another machine: those of this process that decide how vdgs computes, and its own."""
        inherited = {key: value for key, value in os.environ.items() if key.startswith("VDGS_")}
        inherited.pop(PARENT_PID_VARIABLE, None)
        return inherited | dict(self.environment)


@dataclass(frozen=True, kw_only=True)
class TaskResult:
    """How a task ended."""

    name: str
    state: EndState
    attempts: int = 0
    """0: it was not started."""
    seconds: float = 0.0
    """Of the last attempt."""
    reason: str = ""
    """Empty when done."""
    was_killed: bool = False
    """It was asked to stop, and ended before it could save."""
    last_lines: tuple[str, ...] = ()
    """The end of what a failed one printed."""


class TaskListener:
    """Receives what becomes of the tasks while they run, in the thread that runs them; ignores it."""

    def on_placed(self, task: Task, where: str, resumed: bool) -> None:
        """It runs on the machine `where`; `resumed`: a driver that died had begun it there. Before `on_started`."""

    def on_started(self, task: Task, attempt: int) -> None:
        """An attempt, counted from 1, begins."""

    def on_waiting(self, task: Task) -> None:
        """There is room for it, but another process works on it."""

    def on_paused(self, task: Task, why: str) -> None:
        """It saved and lost its place; it will be continued. No attempt is lost."""

    def on_crashed(self, task: Task, how: str, attempts_left: int) -> None:
        """It will be started again."""

    def on_stopping(self, tasks: Sequence[Task]) -> None:
        """These run and were asked to save and end; no more are started."""

    def on_withdrawing(self, tasks: Sequence[Task]) -> None:
        """These wait for a place on a cluster, and were asked to leave its queue."""

    def on_notice(self, text: str) -> None:
        """What a person should know of the cluster."""

    def on_ended(self, task: Task, result: TaskResult) -> None:
        """It will not be started again, or never was."""

    def on_tick(self) -> None:
        """Called regularly, after all other news."""


class Executor(Protocol):
    """Runs tasks."""

    @property
    def max_concurrent(self) -> int:
        """How many tasks run side by side, at most."""

    def run(self, tasks: Sequence[Task], listener: TaskListener) -> list[TaskResult]:
        """Run every task, in their order where there is a choice; the results in the order of the tasks.

        One that fails stops no other but those that come `after` it. When this process is asked to stop (Ctrl-C,
        SIGTERM, SIGHUP), it asks the running tasks once to save and end, and starts no more.
        """


#: Prints a line in a style of rich; the text is no markup.
PrintLine = Callable[[str, str], None]


class LogListener(TaskListener):
    """Prints what a person must know in any case: which task waits, crashed or was asked to stop."""

    def __init__(self, print_line: PrintLine):
        self.print_line = print_line

    def on_waiting(self, task: Task) -> None:
        self.print_line(f"{task.name}: waiting for another process that works on it", "yellow")

    def on_paused(self, task: Task, why: str) -> None:
        self.print_line(f"{task.name}: saved and waits for another turn" + (f" ({why})" if why else ""), "yellow")

    def on_crashed(self, task: Task, how: str, attempts_left: int) -> None:
        text = f"{task.name}: crashed by {how}; continues from its last checkpoint, attempts left: {attempts_left}"
        self.print_line(text, "yellow")

    def on_stopping(self, tasks: Sequence[Task]) -> None:
        names = ", ".join(task.name for task in tasks)
        self.print_line(f"stopping: {names} will save and end (Ctrl-C again kills)", "yellow")

    def on_withdrawing(self, tasks: Sequence[Task]) -> None:
        self.print_line(f"stopping: {', '.join(task.name for task in tasks)} will leave the queue", "yellow")

    def on_notice(self, text: str) -> None:
        self.print_line(text, "yellow")


@dataclass(frozen=True)
class AttemptStarted:
    """Where an attempt runs, and where its part of the output begins."""

    output_from: int = 0
    where: str = ""
    """Empty on this machine."""


@dataclass(frozen=True)
class AttemptResult:
    """How an attempt ended."""

    code: int | None
    """The exit code as `subprocess` counts (negative: a signal); None of one that was lost with its machine."""
    reason: str = ""
    """Why an attempt was lost, in words."""
    out_of_memory: bool = False
    """The system, or the cluster, ended it for want of memory."""
    out_of_time: bool = False
    """It was asked to save because its time was up or its place was needed, and did."""
    node_rejected: bool = False
    """It met a node that cannot work on the run, of which nobody knew; the next attempt avoids it."""
    refused: bool = False
    """The cluster does not take it, and would not take another attempt."""


class Attempt(Protocol):
    """An attempt at a task, wherever its process is."""

    @property
    def start_info(self) -> AttemptStarted | None:
        """None while it waits for a place, or waits for one again."""

    def poll(self) -> AttemptResult | None:
        """How it ended; None while it goes on. Brings `start_info` up to date."""

    def request_stop(self) -> None:
        """Ask it to save and end; one that waits for a place ends at once. Called once."""

    def kill(self) -> None:
        """End it, and whatever it started, at once."""


class Engine(Protocol):
    """Begins attempts."""

    @property
    def max_memory_bytes(self) -> int | None:
        """Bytes that a task can ask for at most; None of an engine that places no task by its resources."""

    def start(self, tasks: Sequence[tuple[Task, int]]) -> Sequence[Attempt | OSError]:
        """Begin an attempt (of that number) at each task, or return what the system refuses."""

    def find_running(self, task: Task) -> Attempt | None:
        """An attempt that goes on without the driver which began it and died."""

    def refresh(self) -> None:
        """Read the news that `Attempt.poll` returns; once before all polls."""
