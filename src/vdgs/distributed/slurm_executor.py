"""Tasks as arrays of jobs of SLURM. Jobs go on without a driver, and one that is started again finds them.

Every submission has a folder of its own, RUN/slurm/NAME: the script, the tasks (`tasks.json`), the record that each job
keeps (`slurm_job`), and what it printed before its first line.
"""

from __future__ import annotations

import hashlib
import secrets
import sys
import time
from collections import defaultdict
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from vdgs.config.executor_options import SlurmOptions
from vdgs.distributed import slurm_commands
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
from vdgs.distributed.slurm_commands import ArrayTaskId, JobState, QueueEntry, SlurmError, UnreadableAnswerError
from vdgs.distributed.slurm_job import SlurmTaskRecord, read_task_record
from vdgs.distributed.task_process import tail_lines
from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty, write_json, write_text
from vdgs.system.child_python import python_command
from vdgs.system.documents import JsonObject
from vdgs.system.quoting import sbatch_directive, shell_line, slurm_file_pattern

#: How often a job that squeue no longer lists is looked for in vain before it counts as lost: shared file systems show
#: a file some seconds after it was written.
MAX_MISSED_POLLS = 6
#: How often in a row SLURM may give no answer: a controller is started again in some minutes.
MAX_FAILED_POLLS = 60
#: SLURM's states of ended jobs, in words.
END_REASONS = {
    "NODE_FAIL": "the loss of its node", "BOOT_FAIL": "the loss of its node", "PREEMPTED": "preemption",
    "TIMEOUT": "its time limit, before it saved", "OUT_OF_MEMORY": "SLURM, for want of memory",
    "DEADLINE": "its deadline",
}  # fmt: skip

#: Seconds after which a job that was cancelled and is still listed is left to SLURM (which ends a script 30 s after it
#: asked it to end, by default), and between two times that it is asked.
CANCEL_SECONDS, CANCEL_AGAIN_SECONDS = 120.0, 15.0
#: What to do about jobs that SLURM does not start.
RELEASE_REMEDY = "It is held: `scontrol release {array}` lets it go on, perhaps by an administrator."
CHANGE_REMEDY = (
    "Stop (Ctrl-C) and run again with what SLURM allows: --slurm.time, --slurm.partition, --slurm.account, --cpus, "
    "--mem-gb, --slurm.sbatch-args."
)

#: The option of sbatch that names nodes to avoid.
EXCLUDE = "--exclude="


@dataclass(frozen=True, kw_only=True)
class SlurmExecutor(ExecutionPolicy):
    """Runs tasks as jobs of SLURM."""

    requirements: NodeRequirements | None = None
    """What a node must see; checked where each job starts."""
    options: SlurmOptions = field(default_factory=SlurmOptions)

    def run(self, tasks: Sequence[Task], listener: TaskListener) -> list[TaskResult]:
        """As `Executor.run`."""
        assert self.requirements is not None
        # All go into the queue, where they wait without a driver too; SLURM limits how many run at a time.
        policy = replace(self, max_concurrent=max(1, len(tasks)))
        engine = _SlurmEngine(self.requirements, self.options, self.max_concurrent, listener)
        return run_tasks(tasks, engine, policy, listener)


@dataclass
class _Submission:
    """An array of jobs, and how often SLURM did not answer whether it takes it."""

    folder: Path
    attempts: list[_SlurmAttempt]
    failures: int = 0
    is_uncertain: bool = False
    """It may have been taken."""
    unread: UnreadableAnswerError | None = None
    """It was taken: it is not submitted again, but looked for in the queue."""

    @property
    def script(self) -> Path:
        return self.folder / "job.sh"


class _SlurmEngine:
    #: Nobody knows what the nodes have; SLURM refuses requests that are too large.
    max_memory_bytes = sys.maxsize

    def __init__(
        self,
        requirements: NodeRequirements,
        options: SlurmOptions,
        at_once: int,
        listener: TaskListener | None = None,
    ):
        self._requirements, self._options, self._at_once = requirements, options, at_once
        self._listener = listener or TaskListener()
        #: What was said already.
        self._notices = set[tuple[str, ...]]()
        self._folder = requirements.folder / "slurm"
        self._prefix = f"vdgs-{hashlib.sha256(str(requirements.folder).encode()).hexdigest()[:10]}-"
        self._failed_polls = 0
        #: Nodes that cannot work on the run, and why; what SLURM did not take yet.
        self.rejected_nodes = dict[str, str]()
        self._unanswered = list[_Submission]()
        self._has_submitted = False
        #: The jobs that squeue lists, by their numbers; those that an earlier driver submitted.
        self.queue = self._list_queue()
        self._earlier = dict(self.queue)

    def start(self, tasks: Sequence[tuple[Task, int]]) -> list[Attempt | OSError]:
        """Submit one array for all tasks that need the same."""
        groups = defaultdict[TaskResources, list[tuple[Task, int]]](list)
        for task, attempt in tasks:
            groups[task.resources].append((task, attempt))
        attempts = dict[str, Attempt | OSError]()
        for resources, group in groups.items():
            attempts |= self._submit(resources, group)
        return [attempts[task.name] for task, _ in tasks]

    def find_running(self, task: Task) -> Attempt | None:
        for task_id, entry in self._earlier.items():
            folder = self._folder / entry.name
            tasks = read_json_or_empty(folder / "tasks.json").get("tasks", {})
            if tasks.get(str(task_id.index), {}).get("name") == task.name:
                return _SlurmAttempt(task_id, folder, self)
        return None

    def refresh(self) -> None:
        try:
            self.queue, self._failed_polls = self._list_queue(), 0
        except SlurmError:
            self._failed_polls += 1
            if self._failed_polls > MAX_FAILED_POLLS:
                raise
            return
        for submission in list(self._unanswered):
            self._submit_again(submission)
        self._report_stuck()

    def notify(self, key: tuple[str, ...], text: str) -> None:
        """Say something, once for each key."""
        if key not in self._notices:
            self._notices.add(key)
            self._listener.on_notice(text)

    def report_unknown(self, folder: Path) -> None:
        """Say that jobs without a number may be in the queue all the same, where that is so."""
        if any(each.folder == folder and each.is_uncertain for each in self._unanswered):
            text = f"SLURM may have taken jobs of unknown number: `scancel --name={folder.name}` ends them."
            self.notify((folder.name,), text)

    def _report_stuck(self) -> None:
        """Say which jobs wait for what time does not bring, and what does."""
        stuck = defaultdict[tuple[str, str], list[QueueEntry]](list)
        for entry in self.queue.values():
            if entry.is_held or entry.is_unfit:
                waits_for = entry.reason if entry.reason not in ("", "None") else entry.state
                stuck[entry.task_id.array, waits_for].append(entry)
        for (array, why), entries in stuck.items():
            remedy = RELEASE_REMEDY if entries[0].is_held else CHANGE_REMEDY
            jobs = ", ".join(str(entry.task_id) for entry in entries[:3]) + (" ..." if len(entries) > 3 else "")
            self.notify((array, why), f"SLURM does not start {jobs} ({why}). {remedy.format(array=array)}")

    def _list_queue(self) -> dict[ArrayTaskId, QueueEntry]:
        return {entry.task_id: entry for entry in slurm_commands.list_queue(self._prefix)}

    @property
    def is_current(self) -> bool:
        """Whether SLURM answered the last `refresh`."""
        return self._failed_polls == 0

    def _submit(self, resources: TaskResources, group: Sequence[tuple[Task, int]]) -> dict[str, Attempt | OSError]:
        name = f"{self._prefix}{time.strftime('%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        folder = self._folder / name
        avoided = frozenset(self.rejected_nodes)
        script = make_batch_script(folder, len(group), resources, self._options, self._at_once, avoided)
        try:
            folder.mkdir(parents=True)
            tasks = {str(index): _task_json(task, attempt) for index, (task, attempt) in enumerate(group)}
            write_json(folder / "tasks.json", {"question": self._requirements.to_dict(), "tasks": tasks})
            write_text(folder / "job.sh", script)
        except OSError as error:
            return {task.name: error for task, _ in group}
        attempts = [_SlurmAttempt(ArrayTaskId("", index), folder, self, avoided) for index in range(len(group))]
        submission = _Submission(folder, attempts)
        try:
            self._list(submission, slurm_commands.submit(submission.script))
        except SlurmError as error:
            if not (self._has_submitted or self.queue or error.is_uncertain):
                raise VdgsError(f"SLURM does not take the jobs: {error}\nThe script: {submission.script}") from error
            self._not_taken(submission, error)  # others are at work, or these are
        return {task.name: attempt for (task, _), attempt in zip(group, attempts, strict=True)}

    def _submit_again(self, submission: _Submission) -> None:
        """Submit what SLURM did not take, unless it did: a busy controller may take a job and answer too late."""
        self._unanswered.remove(submission)
        if all(attempt.has_ended for attempt in submission.attempts):
            return
        name = submission.folder.name
        taken = next((task_id.array for task_id, entry in self.queue.items() if entry.name == name), "")
        try:
            if submission.unread and not taken:
                raise submission.unread
            self._list(submission, taken or slurm_commands.submit(submission.script))
        except SlurmError as error:
            submission.failures += 1
            self._not_taken(submission, error)

    def _not_taken(self, submission: _Submission, error: SlurmError) -> None:
        """Ask again later where that may help; fail at once what SLURM refuses for good: with the nodes that it was to
        avoid, or with more than it has."""
        submission.is_uncertain |= error.is_uncertain
        if isinstance(error, UnreadableAnswerError):
            submission.unread = error
        most = MAX_MISSED_POLLS if submission.unread else MAX_FAILED_POLLS
        if not error.is_final and submission.failures < most:
            self._unanswered.append(submission)
            return
        said = f"({error}; the script: {submission.script})"
        for attempt in submission.attempts:
            attempt.give_up(*self._reason_of_refusal(attempt, error, said))

    def _reason_of_refusal(self, attempt: _SlurmAttempt, error: SlurmError, said: str) -> tuple[str, bool]:
        """Why a job was not taken, and whether another attempt is in vain."""
        if isinstance(error, UnreadableAnswerError):
            return f"{error}. squeue does not list it either. The script: {attempt.folder / 'job.sh'}", True
        if not error.is_final:
            return f"SLURM, which does not take it {said}", False
        if not attempt.avoided:
            return f"SLURM does not take it {said}", True
        node = next(node for node in reversed(self.rejected_nodes) if node in attempt.avoided)
        count = f"the {len(attempt.avoided)} nodes that cannot" if len(attempt.avoided) > 1 else "a node that cannot"
        why = f"without {count} work on the run, at last {node}: {self.rejected_nodes[node]}"
        return f"SLURM does not take it {why} {said}", True

    def _list(self, submission: _Submission, number: str) -> None:
        """Take the jobs of a submission for queued until squeue says otherwise."""
        self._has_submitted = True
        for attempt in submission.attempts:
            attempt.task_id = ArrayTaskId(number, attempt.task_id.index)
            queued = QueueEntry(attempt.task_id, "PENDING", submission.folder.name, "")
            self.queue.setdefault(attempt.task_id, queued)


def make_batch_script(
    folder: Path,
    count: int,
    resources: TaskResources,
    options: SlurmOptions,
    at_once: int,
    avoided: Collection[str] = (),
) -> str:
    """The script for sbatch: an array of `count` jobs, `at_once` of them at a time, on no node that is `avoided`."""
    directives = {
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
        "output": slurm_file_pattern(folder, "%a.out"),
    }
    words = [f"--{name}={value}" for name, value in directives.items() if value]
    asked = [word.removeprefix(EXCLUDE) for word in options.sbatch_args if word.startswith(EXCLUDE)]
    exclude = [EXCLUDE + ",".join([*asked, *sorted(avoided)])] if avoided else []  # SLURM takes the last one
    lines = [sbatch_directive(word) for word in (*words, "--requeue", *options.sbatch_args, *exclude)]
    job = shell_line(python_command("vdgs.distributed.slurm_job", folder))
    setup = [options.setup_command] if options.setup_command else []
    return "\n".join(["#!/bin/bash", *lines, "", *setup, f"exec {job}", ""])


class _SlurmAttempt:
    """A job of an array; the number of its array is empty until SLURM takes it."""

    def __init__(self, task_id: ArrayTaskId, folder: Path, engine: _SlurmEngine, avoided: frozenset[str] = frozenset()):
        self.task_id, self.folder, self._engine, self.avoided = task_id, folder, engine, avoided
        self._result: AttemptResult | None = None
        self._missed_polls = self._turn = 0
        self._is_cancelled = self._is_killed = False
        #: When it was to be cancelled first, and last (seconds of a steady clock).
        self._cancelled_first = self._cancelled_last = 0.0
        self.start_info: AttemptStarted | None = None

    @property
    def has_ended(self) -> bool:
        return self._result is not None

    def give_up(self, why: str, refused: bool) -> None:
        """It is lost before it began; where it was refused, so would be another."""
        self._result = self._result or AttemptResult(None, why, refused=refused)

    def poll(self) -> AttemptResult | None:
        if self._result is None and self.task_id.array and self._engine.is_current:
            entry, record = self._engine.queue.get(self.task_id), read_task_record(self.folder, self.task_id.index)
            if entry is not None:
                self._missed_polls = 0
                self._follow(entry, record)
                self._result = self._left() if self._is_cancelled or self._is_killed else None
            else:
                self._result = self._ended(record)
        return self._result

    def _follow(self, entry: QueueEntry, record: SlurmTaskRecord | None) -> None:
        """Where it runs now, if it does; between two turns it runs nowhere, if only for one poll."""
        if not entry.is_running:
            self.start_info = None
        elif record is not None and record.code is None:  # else it is of the end of an earlier turn
            is_new_turn, self._turn = self.start_info is not None and record.turn != self._turn, record.turn
            self.start_info = None if is_new_turn else AttemptStarted(record.output_from, record.node)

    def request_stop(self) -> None:
        if not self.task_id.array:
            self._engine.report_unknown(self.folder)
            self._result = AttemptResult(EXIT_STOPPED)
        elif self.start_info is None:
            self._is_cancelled = True
            self._cancel()
        else:
            with suppress(SlurmError):  # no answer: a second Ctrl-C cancels it
                slurm_commands.signal_batch(self.task_id, "TERM")

    def kill(self) -> None:
        if not self.task_id.array:
            self.request_stop()
        elif not self._is_killed:
            self._is_killed = True
            self._cancel()

    def _cancel(self) -> None:
        self._cancelled_last = time.monotonic()
        self._cancelled_first = self._cancelled_first or self._cancelled_last
        with suppress(SlurmError):  # no answer: it is asked again
            slurm_commands.cancel(self.task_id)

    def _left(self) -> AttemptResult | None:
        """Of a cancelled job that SLURM still lists: ask again, and in the end say so and do not wait for it."""
        now = time.monotonic()
        if now - self._cancelled_first > CANCEL_SECONDS:
            array = self.task_id.array
            text = f"SLURM still lists jobs of {array} though they were cancelled: they may run. Try `scancel {array}`."
            self._engine.notify((array, "cancelled"), text)
            return AttemptResult(EXIT_STOPPED)
        if now - self._cancelled_last > CANCEL_AGAIN_SECONDS:
            self._cancel()
        return None

    def _ended(self, record: SlurmTaskRecord | None) -> AttemptResult | None:
        """How it ended; None while that may still become known."""
        if self._is_cancelled:
            return AttemptResult(EXIT_STOPPED)
        if record is None or record.code is None:
            self._missed_polls += 1
            return self._lost(record) if self._missed_polls > MAX_MISSED_POLLS else None
        if record.unfit:
            self._engine.rejected_nodes[record.node] = record.unfit
            reason = f"a node that cannot work on the run, {record.node}: {record.unfit}"
            return AttemptResult(None, reason, node_rejected=record.node not in self.avoided)
        if self.start_info is None:
            self.start_info = AttemptStarted(record.output_from, record.node)
        # One that put itself back into the queue may be cancelled there.
        state = self._job().state if record.code == EXIT_STOPPED else ""
        lost_its_place = state == "PREEMPTED" or (record.out_of_time and state != "CANCELLED")
        return AttemptResult(record.code, "", record.out_of_memory, lost_its_place)

    def _job(self) -> JobState:
        return slurm_commands.query_job_state(self.task_id) or JobState("")

    def _lost(self, record: SlurmTaskRecord | None) -> AttemptResult:
        """Its script was ended before it could write how."""
        job = self._job()
        if job.state == "CANCELLED":
            return AttemptResult(EXIT_STOPPED)
        node = record.node if record is not None else job.node
        where = f" {node}" if node else ""
        if record is None and job.state in ("", "FAILED"):
            output = self.folder / f"{self.task_id.index}.out"
            said = tail_lines(output)
            what = f"{said[-1]} ({output})" if said else f"see that it sees {self.folder} (nothing is in {output})"
            return AttemptResult(None, f"an error on its node{where} before its first line: {what}")
        how = END_REASONS.get(job.state, f"SLURM ({job.state})" if job.state else "SLURM, without a word")
        return AttemptResult(None, f"{how}{where}", job.state == "OUT_OF_MEMORY")


def _task_json(task: Task, attempt: int) -> JsonObject:
    return {
        "name": task.name, "command": list(task.command), "output": str(task.output), "attempt": attempt,
        "environment": task.remote_environment(), "folder": None if task.folder is None else str(task.folder),
    }  # fmt: skip
