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
from vdgs.distributed.executor import (
    EXIT_STOPPED,
    Attempt,
    AttemptResult,
    AttemptStarted,
    Task,
    TaskListener,
    TaskResources,
    TaskResult,
)
from vdgs.distributed.node_check import NodeRequirements
from vdgs.distributed.scheduler import ExecutionPolicy, run_tasks
from vdgs.distributed.slurm_commands import (
    ArrayTaskId,
    QueueEntry,
    SlurmError,
    cancel,
    list_queue,
    query_job_state,
    require_slurm,
    signal_batch,
    submit,
)
from vdgs.distributed.slurm_job import SlurmTaskRecord, read_task_record
from vdgs.distributed.task_process import PARENT_PID_VARIABLE
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty, write_json, write_text
from vdgs.system.documents import JsonObject

__all__ = ["SlurmExecutor", "require_slurm"]

#: How often an element that squeue no longer lists may be looked for in vain before it counts as lost: shared file
#: systems show a file some seconds after it was written.
MAX_MISSED_POLLS = 6
#: How often in a row SLURM may give no answer: a controller is started again in some minutes.
MAX_FAILED_POLLS = 60
#: How SLURM calls the ends of jobs, in words.
END_REASONS = {
    "NODE_FAIL": "the loss of its node", "BOOT_FAIL": "the loss of its node", "PREEMPTED": "preemption",
    "TIMEOUT": "its time limit, before it saved", "OUT_OF_MEMORY": "SLURM, for want of memory",
    "DEADLINE": "its deadline",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SlurmExecutor(ExecutionPolicy):
    """Runs tasks as jobs of SLURM."""

    requirements: NodeRequirements | None = None
    """What a node must see; asked where each job starts."""
    options: SlurmOptions = field(default_factory=SlurmOptions)

    def run(self, tasks: Sequence[Task], listener: TaskListener) -> list[TaskResult]:
        """As `Executor.run`."""
        assert self.requirements is not None
        # All go into the queue, where they wait without a driver too; SLURM lets so many at a time run.
        everything = replace(self, max_concurrent=max(1, len(tasks)))
        return run_tasks(
            tasks, _SlurmEngine(self.requirements, self.options, self.max_concurrent), everything, listener
        )


class _SlurmEngine:
    """The engine."""

    #: Nobody knows what the nodes have; SLURM says so when it is asked for too much.
    max_memory_bytes = sys.maxsize

    def __init__(self, requirements: NodeRequirements, options: SlurmOptions, at_once: int):
        self._question, self._options, self._at_once = requirements, options, at_once
        self._folder = requirements.folder / "slurm"
        self._prefix = f"vdgs-{hashlib.sha256(str(requirements.folder).encode()).hexdigest()[:10]}-"
        self._unanswered = 0
        self._listed = self._look()
        #: What an earlier driver submitted.
        self._there = dict(self._listed)

    def start(self, tasks: Sequence[tuple[Task, int]]) -> list[Attempt | OSError]:
        """One array for all that need the same."""
        groups = defaultdict[TaskResources, list[tuple[Task, int]]](list)
        for task, attempt in tasks:
            groups[task.resources].append((task, attempt))
        begun = dict[str, Attempt | OSError]()
        for needs, group in groups.items():
            begun |= self._submit(needs, group)
        return [begun[task.name] for task, _ in tasks]

    def find_running(self, task: Task) -> Attempt | None:
        for element, each in self._there.items():
            folder = self._folder / each.name
            written = read_json_or_empty(folder / "tasks.json").get("tasks", {})
            if written.get(str(element.index), {}).get("name") == task.name:
                return _SlurmAttempt(element, folder, self)
        return None

    def refresh(self) -> None:
        try:
            self._listed, self._unanswered = self._look(), 0
        except SlurmError:
            self._unanswered += 1
            if self._unanswered > MAX_FAILED_POLLS:
                raise

    def _look(self) -> dict[ArrayTaskId, QueueEntry]:
        return {each.task_id: each for each in list_queue(self._prefix)}

    @property
    def answers(self) -> bool:
        """Whether what `list_queue` says is new."""
        return self._unanswered == 0

    def listed(self, element: ArrayTaskId) -> QueueEntry | None:
        return self._listed.get(element)

    def _submit(self, resources: TaskResources, group: Sequence[tuple[Task, int]]) -> dict[str, Attempt | OSError]:
        name = f"{self._prefix}{time.strftime('%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        folder = self._folder / name
        try:
            folder.mkdir(parents=True)
            tasks = {str(index): _task_json(task, attempt) for index, (task, attempt) in enumerate(group)}
            write_json(folder / "tasks.json", {"question": self._question.to_dict(), "tasks": tasks})
            write_text(
                folder / "job.sh", make_batch_script(folder, len(group), resources, self._options, self._at_once)
            )
        except OSError as error:
            return {task.name: error for task, _ in group}
        try:
            number = submit(folder / "job.sh")
        except SlurmError as error:
            raise VdgsError(f"SLURM does not take the jobs: {error}\nThe script: {folder / 'job.sh'}") from error
        elements = [ArrayTaskId(number, index) for index in range(len(group))]
        for element in elements:  # they wait until squeue says otherwise
            self._listed[element] = QueueEntry(element, "PENDING", name, "")
        return {
            task.name: _SlurmAttempt(element, folder, self)
            for (task, _), element in zip(group, elements, strict=True)
        }  # fmt: skip


def make_batch_script(folder: Path, count: int, resources: TaskResources, options: SlurmOptions, at_once: int) -> str:
    """What sbatch is given: an array of `count` jobs, `at_once` of them at a time."""
    asked = {
        "job-name": folder.name,
        "array": f"0-{count - 1}" + (f"%{at_once}" if at_once < count else ""),
        "nodes": "1",
        "ntasks": "1",
        "cpus-per-task": str(resources.cpus),
        "mem": f"{-(-resources.memory_bytes // (1 << 20))}M" if resources.memory_bytes else "",
        "gres": f"gpu:{resources.gpus:g}" if resources.gpus else "",
        "partition": options.partition,
        "account": options.account,
        "time": options.time,
        "signal": f"B:USR1@{options.grace_seconds}",
        "open-mode": "append",
        "output": str(folder / "%a.out"),
    }
    lines = [f"#SBATCH --{name}={value}" for name, value in asked.items() if value]
    lines += ["#SBATCH --requeue", *(f"#SBATCH {word}" for word in options.sbatch_args)]
    job = shlex.join([sys.executable, "-m", "vdgs.distributed.slurm_job", str(folder)])
    setup = [options.setup_command] if options.setup_command else []
    return "\n".join(["#!/bin/bash", *lines, "", *setup, f"exec {job}", ""])


class _SlurmAttempt:
    def __init__(self, element: ArrayTaskId, folder: Path, queue: _SlurmEngine):
        self._element, self._folder, self._queue = element, folder, queue
        self._over: AttemptResult | None = None
        self._missed = self._turn = 0
        self._cancelled = self._killed = False
        self.start_info: AttemptStarted | None = None

    def poll(self) -> AttemptResult | None:
        if self._over is None and self._queue.answers:
            listed, record = self._queue.listed(self._element), read_task_record(self._folder, self._element.index)
            if listed is not None:
                self._missed = 0
                self._follow(listed, record)
            else:
                self._over = self._ended(record)
        return self._over

    def _follow(self, listed: QueueEntry, record: SlurmTaskRecord | None) -> None:
        """Where it runs now, if it does; between two turns it runs nowhere, and be it for one look."""
        if not listed.is_running:
            self.start_info = None
        elif record is not None and record.code is None:  # else it says what the end of an earlier turn was
            another, self._turn = self.start_info is not None and record.turn != self._turn, record.turn
            self.start_info = None if another else AttemptStarted(record.output_from, record.node)

    def request_stop(self) -> None:
        if self.start_info is None:
            self._cancelled = True
            cancel(self._element)
        else:
            signal_batch(self._element, "TERM")

    def kill(self) -> None:
        if not self._killed:
            self._killed = True
            cancel(self._element)

    def _ended(self, record: SlurmTaskRecord | None) -> AttemptResult | None:
        """How it ended; None while that may still become known."""
        if self._cancelled:
            return AttemptResult(EXIT_STOPPED)
        if record is None or record.code is None:
            self._missed += 1
            return self._lost(record) if self._missed > MAX_MISSED_POLLS else None
        if self.start_info is None and not record.unfit:
            self.start_info = AttemptStarted(record.output_from, record.node)
        if record.unfit:
            return AttemptResult(None, f"a node that cannot work on the run, {record.node}: {record.unfit}")
        preempted = record.code == EXIT_STOPPED and not record.out_of_time and self._fate_state() == "PREEMPTED"
        return AttemptResult(record.code, "", record.out_of_memory, record.out_of_time or preempted)

    def _fate_state(self) -> str:
        found = query_job_state(self._element)
        return "" if found is None else found.state

    def _lost(self, record: SlurmTaskRecord | None) -> AttemptResult:
        """Its script was ended before it could write down how."""
        found = query_job_state(self._element)
        state = "" if found is None else found.state
        node = record.node if record is not None else found.node if found is not None else ""
        if state == "CANCELLED":
            return AttemptResult(EXIT_STOPPED)
        where = f" {node}" if node else ""
        if record is None and state in ("", "FAILED"):
            hint = f"see that it sees {self._folder} (what it printed: {self._folder / f'{self._element.index}.out'})"
            return AttemptResult(None, f"an error on its node{where} before its first line; {hint}")
        how = END_REASONS.get(state, f"SLURM ({state})" if state else "SLURM, without a word")
        return AttemptResult(None, f"{how}{where}", state == "OUT_OF_MEMORY")


def _task_json(task: Task, attempt: int) -> JsonObject:
    own = {
        name: value for name, value in os.environ.items() if name.startswith("VDGS_") and name != PARENT_PID_VARIABLE
    }
    return {
        "name": task.name, "command": list(task.command), "output": str(task.output), "attempt": attempt,
        "environment": own | dict(task.environment), "folder": None if task.folder is None else str(task.folder),
    }  # fmt: skip
