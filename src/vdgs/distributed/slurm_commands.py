"""SLURM's own commands and what they print: submit, list, signal, put back into the queue."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import VdgsError

SLURM_COMMANDS = ("sbatch", "squeue", "scancel", "scontrol")
#: Seconds that a command gets: the controller of a busy cluster may take its time.
COMMAND_TIMEOUT_SECONDS = 120.0
#: States of squeue in which a job has a place. SUSPENDED keeps it.
RUNNING_STATES = ("RUNNING", "SUSPENDED", "COMPLETING", "STAGE_OUT", "SIGNALING")
#: What SLURM's commands say of a job that they will never take. All else may pass: a controller that is busy or starts
#: again, as many jobs as a user may have at a time, nodes that are down.
_FINAL = re.compile(
    r"configuration is not available|can ?not be satisfied|more processors|not permitted|unrecognized option"
    r"|invalid (account|partition|qos|feature|constraint|node|generic resource|user|job|wckey|reservation|time|memory)",
    re.IGNORECASE,
)
#: What it says where it may have taken a job all the same.
_UNCERTAIN = re.compile(r"timed out|zero bytes", re.IGNORECASE)
#: Lines of answers. What a site prints besides (greetings, the name of a cluster) has another form.
_SUBMITTED = re.compile(r"(\d+)(?:;\S+)?")
_QUEUED = re.compile(r"(\d+)\|(\d+)\|([A-Z_]+)\|([^|]*)\|([^|]*)\|(.*)")
_ACCOUNTED = re.compile(r"([A-Z_]+)(?: by \w+)?\+?\|(.*)")  # "CANCELLED by 1000"
#: States and reasons of waiting that end when someone releases the job.
_HELD = re.compile(r"REQUEUE_HOLD|SPECIAL_EXIT|held|JobHold", re.IGNORECASE)
#: Reasons of waiting that end when the job asks for something else.
_UNFIT = re.compile(
    r"BadConstraints|Partition(Time|Node)Limit|(Assoc|QOS)(Max|Min)\w*(PerJob|PerNode)\w*"
    r"|(Assoc|QOS)Grp(?!\w*Run)\w*Minutes\w*"
    r"|AccountNotAllowed|Invalid(Account|QOS)|QOSNotAllowed|DependencyNeverSatisfied|ReservationDeleted"
)


@dataclass(frozen=True)
class ArrayTaskId:
    """A job of an array; `array` is the number that sbatch gave."""

    array: str
    index: int

    def __str__(self) -> str:
        return f"{self.array}_{self.index}"


@dataclass(frozen=True)
class QueueEntry:
    """A job as squeue lists it."""

    task_id: ArrayTaskId
    state: str
    name: str
    node: str
    reason: str = ""
    """Why it waits, as SLURM calls it."""

    @property
    def is_held(self) -> bool:
        """Whether it waits until someone releases it."""
        return not self.is_running and _HELD.search(f"{self.state} {self.reason}") is not None

    @property
    def is_unfit(self) -> bool:
        """Whether it waits in vain for what it asks for, as long as nobody changes SLURM's limits."""
        return self.state == "PENDING" and _UNFIT.fullmatch(self.reason) is not None

    @property
    def is_running(self) -> bool:
        return self.state in RUNNING_STATES


@dataclass(frozen=True)
class JobState:
    """How a job ended that squeue does not list any more."""

    state: str
    node: str = ""


class SlurmError(VdgsError):
    """SLURM refused, or does not answer."""

    @property
    def is_final(self) -> bool:
        """Whether it would refuse the same again."""
        return _FINAL.search(str(self)) is not None

    @property
    def is_uncertain(self) -> bool:
        """Whether it may have done what it was asked for."""
        return isinstance(self, UnreadableAnswerError) or _UNCERTAIN.search(str(self)) is not None


class UnreadableAnswerError(SlurmError):
    """SLURM took a job, and its number is not known."""

    @property
    def is_final(self) -> bool:
        """Whatever the words that it quotes say."""
        return False


def require_slurm() -> None:
    """Raise VdgsError where SLURM's commands are not there."""
    if missing := [name for name in SLURM_COMMANDS if shutil.which(name) is None]:
        raise VdgsError(f"There is no {', no '.join(missing)} here. Run vdgs where jobs are submitted to SLURM.")


def submit(script: Path) -> str:
    """Submit a script; the number of the job. Raises SlurmError with SLURM's own words, UnreadableAnswerError where the
    number is not among them.

    SLURM's variables, where this process is a job itself, are not passed on: sbatch would take them for requests.
    """
    environment = {key: value for key, value in os.environ.items() if key == "SLURM_CONF" or key[:6] != "SLURM_"}
    answer = _call(["sbatch", "--parsable", str(script)], environment=environment)
    found = [match[1] for line in answer.splitlines() if (match := _SUBMITTED.fullmatch(line.strip()))]
    if not found:
        raise UnreadableAnswerError(f"sbatch took it, but its answer has no line with the number: {answer.strip()!r}")
    return found[-1]


def list_queue(prefix: str) -> list[QueueEntry]:
    """The jobs of this user that wait or run, of arrays whose names begin with a prefix."""
    lines = _call(["squeue", "--me", "--noheader", "--array", "--format=%F|%K|%T|%j|%N|%r"]).splitlines()
    entries = []
    for line in lines:
        found = _QUEUED.fullmatch(line.strip())
        if found is not None and found[4].startswith(prefix):
            array, index, state, name, node, reason = found.groups()
            entries.append(QueueEntry(ArrayTaskId(array, int(index)), state, name, node, reason))
    return entries


def query_job_state(task_id: ArrayTaskId) -> JobState | None:
    """How a job ended that squeue does not list any more; None where that is not known."""
    with suppress(SlurmError):  # the controller forgets ended jobs after some minutes; accounting may remember them
        text = _call(["scontrol", "--oneliner", "show", "job", str(task_id)])
        values = dict(word.partition("=")[::2] for word in text.split() if "=" in word)
        if values.get("JobState"):
            return JobState(values["JobState"], _clean_node_name(values.get("NodeList", "")))
    if shutil.which("sacct") is None:
        return None
    with suppress(SlurmError):
        text = _call(["sacct", "-X", "-n", "-P", "-D", "-j", str(task_id), "-o", "State,NodeList"])
        found = [match for line in text.splitlines() if (match := _ACCOUNTED.fullmatch(line.strip()))]
        if found:
            return JobState(found[-1][1], _clean_node_name(found[-1][2]))
    return None


def signal_batch(task_id: ArrayTaskId, name: str) -> None:
    """Send a signal to the script of a job."""
    _call(["scancel", "--batch", f"--signal={name}", str(task_id)], check=False)


def cancel(task_id: ArrayTaskId) -> None:
    """Take a job out of the queue, or end it."""
    _call(["scancel", str(task_id)], check=False)


def requeue(task_id: ArrayTaskId) -> bool:
    """Put a running job back into the queue, which ends its script at once; False where SLURM refuses."""
    result = subprocess.run(["scontrol", "requeue", str(task_id)], capture_output=True, text=True, check=False)
    return result.returncode == 0


def _clean_node_name(node: str) -> str:
    return "" if node in ("(null)", "None assigned", "None") else node


def _call(command: Sequence[str], check: bool = True, environment: Mapping[str, str] | None = None) -> str:
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_SECONDS, check=False, env=environment
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SlurmError(f"{command[0]}: {error}") from error
    if check and result.returncode:
        message = (result.stderr or result.stdout).strip() or f"exit code {result.returncode}"
        raise SlurmError(f"{command[0]}: {message}")
    return result.stdout
