"""What a job of SLURM runs: one task of those that a driver submitted together, watched in the driver's place.

    python -m vdgs.distributed.slurm_job FOLDER     (with SLURM's variables of the job)

FOLDER/tasks.json holds the task of job n of the array, FOLDER/n.json how it went. SIGUSR1, which SLURM sends some time
before the limit, lets the task save; the job is then put back into the queue, so that it goes on without a driver.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from vdgs.distributed.executor import EXIT_EXPLAINED, EXIT_STOPPED
from vdgs.distributed.node_check import check_node
from vdgs.distributed.slurm_commands import ArrayTaskId, requeue
from vdgs.distributed.task_process import TaskProcess, oom_kill_count
from vdgs.system.atomic_files import read_json, write_json
from vdgs.system.documents import JsonObject
from vdgs.system.stop_signals import STOP_SIGNALS


@dataclass(frozen=True, kw_only=True)
class SlurmTaskRecord:
    """How far a job is, in FOLDER/n.json."""

    node: str
    output_from: int
    turn: int = 0
    """How often it was put back into the queue before."""
    code: int | None = None
    """The exit code of the command; None while it runs."""
    out_of_memory: bool = False
    out_of_time: bool = False
    """Asked to save before the time limit, and did."""
    unfit: str = ""
    """Why the node cannot work on the run."""
    progress: int | None = None
    """How far the task was when its time was up: see `requeue`."""


def read_task_record(folder: Path, index: int) -> SlurmTaskRecord | None:
    """The record of a job; None before it began, or while it is written."""
    try:
        return SlurmTaskRecord(**read_json(folder / f"{index}.json"))
    except Exception:  # no such file, or not a whole one yet: asked again soon
        return None


def main(arguments: list[str]) -> int:
    """Do the task; its exit code."""
    folder, variables = Path(arguments[0]), os.environ
    task_id = ArrayTaskId(variables["SLURM_ARRAY_JOB_ID"], int(variables["SLURM_ARRAY_TASK_ID"]))
    turn = int(variables.get("SLURM_RESTART_COUNT", 0))
    content = read_json(folder / "tasks.json")
    task, before = content["tasks"][str(task_id.index)], read_task_record(folder, task_id.index)
    answer = check_node(content["question"])
    node = variables.get("SLURMD_NODENAME") or socket.gethostname()  # as SLURM calls it
    record = SlurmTaskRecord(node=node, output_from=_size(task["output"]), turn=turn)
    update = _record_updater(folder / f"{task_id.index}.json", record)
    if answer["problems"]:
        update(code=EXIT_EXPLAINED[0], unfit=answer["problems"][0])
        return EXIT_EXPLAINED[0]
    oom_kills = oom_kill_count()
    process = TaskProcess(task["command"], Path(task["output"]), task["environment"], task["attempt"] + turn)
    signals = _forward_signals(process)
    update(output_from=process.output_offset)
    code = process.wait()
    if code != EXIT_STOPPED or signals != [signal.SIGUSR1]:
        update(code=code, out_of_memory=code == -signal.SIGKILL and oom_kill_count() > oom_kills)
        return code if code >= 0 else 128 - code
    from vdgs.distributed.scheduler import stage_iteration

    progress = stage_iteration(None if task["folder"] is None else Path(task["folder"]))
    update(code=code, out_of_time=True, progress=progress)
    if before is None or before.progress is None or progress > before.progress:
        requeue(task_id)  # ends this process if it works; else the driver submits it again
    return code


def _forward_signals(process: TaskProcess) -> list[int]:
    """Ask the process to save when this one is asked to; returns a list that fills with the signals, each once."""
    received = list[int]()

    def forward(number: int, _frame: object) -> None:
        if number not in received:
            received.append(number)
        process.terminate()

    for number in (*STOP_SIGNALS, signal.SIGUSR1):
        signal.signal(number, forward)
    return received


def _record_updater(file: Path, record: SlurmTaskRecord) -> Callable[..., None]:
    """A function that adds values to the record of this job."""
    content: JsonObject = asdict(record)

    def update(**values: Any) -> None:
        content.update(values)
        write_json(file, content)

    return update


def _size(output: str) -> int:
    try:
        return Path(output).stat().st_size
    except OSError:
        return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
