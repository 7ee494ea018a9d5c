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
COMMANDS = ("sbatch", "squeue", "scancel", "scontrol")
#: Seconds that a command gets: the controller of a busy cluster may take its time.
ANSWER_SECONDS = 120.0
#: States of squeue in which a job has a place. SUSPENDED keeps it.
PLACED = ("RUNNING", "SUSPENDED", "COMPLETING", "STAGE_OUT", "SIGNALING")


@dataclass(frozen=True)
class Element:
    """An element of an array of jobs."""

    array: str
    """The number that sbatch gave."""
    index: int

    def __str__(self) -> str:
        return f"{self.array}_{self.index}"


@dataclass(frozen=True)
class Listed:
    """An element as squeue lists it."""

    element: Element
    state: str
    name: str
    node: str

    @property
    def placed(self) -> bool:
        return self.state in PLACED


@dataclass(frozen=True)
class Fate:
    """What SLURM says of an element that is not listed any more."""

    state: str
    node: str = ""


class SlurmError(VdgsError):
    """SLURM refused, or does not answer."""


def refuse_without_slurm() -> None:
    """Raise VdgsError where SLURM's commands are not there."""
    if missing := [name for name in COMMANDS if shutil.which(name) is None]:
        raise VdgsError(f"There is no {', no '.join(missing)} here. Run vdgs where jobs are submitted to SLURM.")


def submit(script: Path) -> str:
    """Submit a script; the number of the job. Raises SlurmError with SLURM's own words.

    What SLURM told this process, where it is a job itself, is not passed on: it would be taken for what is asked for.
    """
    told = {name: value for name, value in os.environ.items() if name == "SLURM_CONF" or not name.startswith("SLURM_")}
    return _call(["sbatch", "--parsable", str(script)], environment=told).strip().split(";")[0]


def listed(prefix: str) -> list[Listed]:
    """Elements of this user's that wait or run, of jobs whose names begin so."""
    lines = _call(["squeue", "--me", "--noheader", "--array", "--format=%F|%K|%T|%j|%N"]).splitlines()
    found = []
    for line in lines:
        array, index, state, name, node = (*line.strip().split("|"), "", "", "", "")[:5]
        if name.startswith(prefix) and index.isdecimal():
            found.append(Listed(Element(array, int(index)), state, name, node))
    return found


def fate(element: Element) -> Fate | None:
    """How an element ended that is not listed any more; None where nobody remembers."""
    try:
        said = _call(["scontrol", "--oneliner", "show", "job", str(element)])
        facts = dict(word.partition("=")[::2] for word in said.split() if "=" in word)
        if facts.get("JobState"):
            return Fate(facts["JobState"], _none(facts.get("NodeList", "")))
    except SlurmError:
        pass  # the controller forgets ended jobs after some minutes; accounting may remember them
    if shutil.which("sacct") is None:
        return None
    try:
        said = _call(["sacct", "-X", "-n", "-P", "-D", "-j", str(element), "-o", "State,NodeList"]).strip()
    except SlurmError:
        return None
    if not said:
        return None
    state, _, node = said.splitlines()[-1].partition("|")
    return Fate(state.split(" ")[0], _none(node))  # "CANCELLED by 1000"


def signal_batch(element: Element, name: str) -> None:
    """Send a signal to the script of an element."""
    _call(["scancel", "--batch", f"--signal={name}", str(element)], check=False)


def cancel(element: Element) -> None:
    """Take an element out of the queue, or end it."""
    _call(["scancel", str(element)], check=False)


def requeue(element: Element) -> bool:
    """Put a running element back into the queue, which ends its script at once; False where SLURM refuses."""
    done = subprocess.run(["scontrol", "requeue", str(element)], capture_output=True, text=True, check=False)
    return done.returncode == 0


def _none(node: str) -> str:
    return "" if node in ("(null)", "None assigned", "None") else node


def _call(command: Sequence[str], check: bool = True, environment: Mapping[str, str] | None = None) -> str:
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=ANSWER_SECONDS, check=False, env=environment
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SlurmError(f"{command[0]}: {error}") from error
    if check and done.returncode:
        said = (done.stderr or done.stdout).strip() or f"exit code {done.returncode}"
        raise SlurmError(f"{command[0]}: {said}")
    return done.stdout
