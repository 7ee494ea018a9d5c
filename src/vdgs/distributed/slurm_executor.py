"""Tasks as arrays of jobs of SLURM. Jobs go on without a driver, and one that is started again finds them.

Everything about a submission is in a folder of its own, RUN/slurm/NAME: the script, the tasks (`tasks.json`), what each
job says of itself (`slurm_job`), and what it printed before its first line.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shlex
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from vdgs.config.executor_options import SlurmOptions
from vdgs.distributed.executor import STOPPED, Attempt, Begun, End, Listener, Needs, Outcome, Task
from vdgs.distributed.node_check import Question
from vdgs.distributed.scheduler import Policy, run_crew
from vdgs.distributed.slurm_commands import (
    Element,
    Listed,
    SlurmError,
    cancel,
    fate,
    listed,
    refuse_without_slurm,
    signal_batch,
    submit,
)
from vdgs.distributed.slurm_job import Record, read
from vdgs.distributed.task_process import PARENT
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_record, write_json, write_text
from vdgs.system.documents import JsonObject

__all__ = ["SlurmExecutor", "refuse_without_slurm"]

#: How often an element that squeue no longer lists may be looked for in vain before it counts as lost: shared file
#: systems show a file some seconds after it was written.
LOOKS = 6
#: How often in a row SLURM may give no answer: a controller is started again in some minutes.
UNANSWERED = 60
#: How SLURM calls the ends of jobs, in words.
ENDS = {
    "NODE_FAIL": "the loss of its node", "BOOT_FAIL": "the loss of its node", "PREEMPTED": "preemption",
    "TIMEOUT": "its time limit, before it saved", "OUT_OF_MEMORY": "SLURM, for want of memory",
    "DEADLINE": "its deadline",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SlurmExecutor(Policy):
    """Runs tasks as jobs of SLURM."""

    question: Question | None = None
    """What a node must see; asked where each job starts."""
    options: SlurmOptions = field(default_factory=SlurmOptions)

    def run(self, tasks: Sequence[Task], listener: Listener) -> list[Outcome]:
        """As `Executor.run`."""
        assert self.question is not None
        # All go into the queue, where they wait without a driver too; SLURM lets so many at a time run.
        everything = replace(self, at_once=max(1, len(tasks)))
        return run_crew(tasks, _Queue(self.question, self.options, self.at_once), everything, listener)


class _Queue:
    """The engine."""

    #: Nobody knows what the nodes have; SLURM says so when it is asked for too much.
    most_memory = sys.maxsize

    def __init__(self, question: Question, options: SlurmOptions, at_once: int):
        self._question, self._options, self._at_once = question, options, at_once
        self._folder = question.folder / "slurm"
        self._prefix = f"vdgs-{hashlib.sha256(str(question.folder).encode()).hexdigest()[:10]}-"
        self._unanswered = 0
        self._listed = self._look()
        #: What an earlier driver submitted.
        self._there = dict(self._listed)

    def start(self, tasks: Sequence[tuple[Task, int]]) -> list[Attempt | OSError]:
        """One array for all that need the same."""
        groups = defaultdict[Needs, list[tuple[Task, int]]](list)
        for task, attempt in tasks:
            groups[task.needs].append((task, attempt))
        begun = dict[str, Attempt | OSError]()
        for needs, group in groups.items():
            begun |= self._submit(needs, group)
        return [begun[task.name] for task, _ in tasks]

    def find(self, task: Task) -> Attempt | None:
        for element, each in self._there.items():
            folder = self._folder / each.name
            written = read_record(folder / "tasks.json").get("tasks", {})
            if written.get(str(element.index), {}).get("name") == task.name:
                return _SlurmAttempt(element, folder, self)
        return None

    def refresh(self) -> None:
        try:
            self._listed, self._unanswered = self._look(), 0
        except SlurmError:
            self._unanswered += 1
            if self._unanswered > UNANSWERED:
                raise

    def _look(self) -> dict[Element, Listed]:
        return {each.element: each for each in listed(self._prefix)}

    @property
    def answers(self) -> bool:
        """Whether what `listed` says is new."""
        return self._unanswered == 0

    def listed(self, element: Element) -> Listed | None:
        return self._listed.get(element)

    def _submit(self, needs: Needs, group: Sequence[tuple[Task, int]]) -> dict[str, Attempt | OSError]:
        name = f"{self._prefix}{time.strftime('%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        folder = self._folder / name
        try:
            folder.mkdir(parents=True)
            tasks = {str(index): _plain(task, attempt) for index, (task, attempt) in enumerate(group)}
            write_json(folder / "tasks.json", {"question": self._question.plain(), "tasks": tasks})
            write_text(folder / "job.sh", script(folder, len(group), needs, self._options, self._at_once))
        except OSError as error:
            return {task.name: error for task, _ in group}
        try:
            number = submit(folder / "job.sh")
        except SlurmError as error:
            raise VdgsError(f"SLURM does not take the jobs: {error}\nThe script: {folder / 'job.sh'}") from error
        elements = [Element(number, index) for index in range(len(group))]
        for element in elements:  # they wait until squeue says otherwise
            self._listed[element] = Listed(element, "PENDING", name, "")
        return {
            task.name: _SlurmAttempt(element, folder, self)
            for (task, _), element in zip(group, elements, strict=True)
        }  # fmt: skip


def script(folder: Path, count: int, needs: Needs, options: SlurmOptions, at_once: int) -> str:
    """What sbatch is given: an array of `count` jobs, `at_once` of them at a time."""
    asked = {
        "job-name": folder.name,
        "array": f"0-{count - 1}" + (f"%{at_once}" if at_once < count else ""),
        "nodes": "1",
        "ntasks": "1",
        "cpus-per-task": str(needs.processors),
        "mem": f"{-(-needs.memory_bytes // (1 << 20))}M" if needs.memory_bytes else "",
        "gres": f"gpu:{needs.gpus:g}" if needs.gpus else "",
        "partition": options.partition,
        "account": options.account,
        "time": options.time,
        "signal": f"B:USR1@{options.grace_seconds}",
        "open-mode": "append",
        "output": str(folder / "%a.out"),
    }
    lines = [f"#SBATCH --{name}={value}" for name, value in asked.items() if value]
    lines += ["#SBATCH --requeue", *(f"#SBATCH {word}" for word in options.options)]
    job = shlex.join([sys.executable, "-m", "vdgs.distributed.slurm_job", str(folder)])
    setup = [options.setup] if options.setup else []
    return "\n".join(["#!/bin/bash", *lines, "", *setup, f"exec {job}", ""])


class _SlurmAttempt:
    def __init__(self, element: Element, folder: Path, queue: _Queue):
        self._element, self._folder, self._queue = element, folder, queue
        self._over: End | None = None
        self._missed = self._turn = 0
        self._cancelled = self._killed = False
        self.begun: Begun | None = None

    def look(self) -> End | None:
        if self._over is None and self._queue.answers:
            listed, record = self._queue.listed(self._element), read(self._folder, self._element.index)
            if listed is not None:
                self._missed = 0
                self._follow(listed, record)
            else:
                self._over = self._ended(record)
        return self._over

    def _follow(self, listed: Listed, record: Record | None) -> None:
        """Where it runs now, if it does; between two turns it runs nowhere, and be it for one look."""
        if not listed.placed:
            self.begun = None
        elif record is not None and record.code is None:  # else it says what the end of an earlier turn was
            another, self._turn = self.begun is not None and record.turn != self._turn, record.turn
            self.begun = None if another else Begun(record.output_from, record.node)

    def ask_to_stop(self) -> None:
        if self.begun is None:
            self._cancelled = True
            cancel(self._element)
        else:
            signal_batch(self._element, "TERM")

    def kill(self) -> None:
        if not self._killed:
            self._killed = True
            cancel(self._element)

    def _ended(self, record: Record | None) -> End | None:
        """How it ended; None while that may still become known."""
        if self._cancelled:
            return End(STOPPED)
        if record is None or record.code is None:
            self._missed += 1
            return self._lost(record) if self._missed > LOOKS else None
        if self.begun is None and not record.unfit:
            self.begun = Begun(record.output_from, record.node)
        if record.unfit:
            return End(None, f"a node that cannot work on the run, {record.node}: {record.unfit}")
        preempted = record.code == STOPPED and not record.out_of_time and self._fate_state() == "PREEMPTED"
        return End(record.code, "", record.out_of_memory, record.out_of_time or preempted)

    def _fate_state(self) -> str:
        found = fate(self._element)
        return "" if found is None else found.state

    def _lost(self, record: Record | None) -> End:
        """Its script was ended before it could write down how."""
        found = fate(self._element)
        state = "" if found is None else found.state
        node = record.node if record is not None else found.node if found is not None else ""
        if state == "CANCELLED":
            return End(STOPPED)
        where = f" {node}" if node else ""
        if record is None and state in ("", "FAILED"):
            hint = f"see that it sees {self._folder} (what it printed: {self._folder / f'{self._element.index}.out'})"
            return End(None, f"an error on its node{where} before its first line; {hint}")
        how = ENDS.get(state, f"SLURM ({state})" if state else "SLURM, without a word")
        return End(None, f"{how}{where}", state == "OUT_OF_MEMORY")


def _plain(task: Task, attempt: int) -> JsonObject:
    own = {name: value for name, value in os.environ.items() if name.startswith("VDGS_") and name != PARENT}
    return {
        "name": task.name, "command": list(task.command), "output": str(task.output), "attempt": attempt,
        "environment": own | dict(task.environment), "folder": None if task.folder is None else str(task.folder),
    }  # fmt: skip
