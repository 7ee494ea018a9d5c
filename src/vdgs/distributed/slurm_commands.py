"""SLURM's own commands, called and read: submit, look, signal, put back into the queue."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import VdgsError

#: What is needed of it.
SLURM_COMMANDS = ("sbatch", "squeue", "scancel", "scontrol")
#: Seconds that a command gets: the controller of a busy cluster may take its time.
COMMAND_TIMEOUT_SECONDS = 120.0
#: States of squeue in which a job has a place. SUSPENDED keeps it.
RUNNING_STATES = ("RUNNING", "SUSPENDED", "COMPLETING", "STAGE_OUT", "SIGNALING")


@dataclass(frozen=True)
class ArrayTaskId:
    """An element of an array of jobs."""

    array: str
    """The number that sbatch gave."""
    index: int

    def __str__(self) -> str:
        return f"{self.array}_{self.index}"


@dataclass(frozen=True)
class QueueEntry:
    """An element as squeue lists it."""

    task_id: ArrayTaskId
    state: str
    name: str
    node: str

    @property
    def is_running(self) -> bool:
        return self.state in RUNNING_STATES


@dataclass(frozen=True)
class JobState:
    """What SLURM says of an element that is not listed any more."""

    state: str
    node: str = ""


class SlurmError(VdgsError):
    """SLURM refused, or does not answer."""


def require_slurm() -> None:
    """Raise VdgsError where SLURM's commands are not there."""
    if missing := [name for name in SLURM_COMMANDS if shutil.which(name) is None]:
        raise VdgsError(f"There is no {', no '.join(missing)} here. Run vdgs where jobs are submitted to SLURM.")


def submit(script: Path) -> str:
    """Submit a script; the number of the job. Raises SlurmError with SLURM's own words.

    What SLURM told this process, where it is a job itself, is not passed on: it would be taken for what is asked for.
    """
    told = {name: value for name, value in os.environ.items() if name == "SLURM_CONF" or not name.startswith("SLURM_")}
    return _call(["sbatch", "--parsable", str(script)], environment=told).strip().split(";")[0]


def list_queue(prefix: str) -> list[QueueEntry]:
    """Elements of this user's that wait or run, of jobs whose names begin so."""
    lines = _call(["squeue", "--me", "--noheader", "--array", "--format=%F|%K|%T|%j|%N"]).splitlines()
    found = []
    for line in lines:
        array, index, state, name, node = (*line.strip().split("|"), "", "", "", "")[:5]
        if name.startswith(prefix) and index.isdecimal():
            found.append(QueueEntry(ArrayTaskId(array, int(index)), state, name, node))
    return found


def query_job_state(task_id: ArrayTaskId) -> JobState | None:
    """How an element ended that is not listed any more; None where nobody remembers."""
    try:
        said = _call(["scontrol", "--oneliner", "show", "job", str(task_id)])
        facts = dict(word.partition("=")[::2] for word in said.split() if "=" in word)
        if facts.get("JobState"):
            return JobState(facts["JobState"], _clean_node_name(facts.get("NodeList", "")))
    except SlurmError:
        pass  # the controller forgets ended jobs after some minutes; accounting may remember them
    if shutil.which("sacct") is None:
        return None
    try:
        said = _call(["sacct", "-X", "-n", "-P", "-D", "-j", str(task_id), "-o", "State,NodeList"]).strip()
    except SlurmError:
        return None
    if not said:
        return None
    state, _, node = said.splitlines()[-1].partition("|")
    return JobState(state.split(" ")[0], _clean_node_name(node))  # "CANCELLED by 1000"


def signal_batch(task_id: ArrayTaskId, name: str) -> None:
    """Send a signal to the script of an element."""
    _call(["scancel", "--batch", f"--signal={name}", str(task_id)], check=False)


def cancel(task_id: ArrayTaskId) -> None:
    """Take an element out of the queue, or end it."""
    _call(["scancel", str(task_id)], check=False)


def requeue(task_id: ArrayTaskId) -> bool:
    """Put a running element back into the queue, which ends its script at once; False where SLURM refuses."""
    done = subprocess.run(["scontrol", "requeue", str(task_id)], capture_output=True, text=True, check=False)
    return done.returncode == 0


def _clean_node_name(node: str) -> str:
    return "" if node in ("(null)", "None assigned", "None") else node


def _call(command: Sequence[str], check: bool = True, environment: Mapping[str, str] | None = None) -> str:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_SECONDS, check=False, env=environment
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SlurmError(f"{command[0]}: {error}") from error
    if check and done.returncode:
        said = (done.stderr or done.stdout).strip() or f"exit code {done.returncode}"
        raise SlurmError(f"{command[0]}: {said}")
    return done.stdout
