"""A SLURM of one machine for tests: the real one where it is installed, or a stand-in for its commands."""

from __future__ import annotations

import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from support.commands import PATIENCE_SECONDS, wait_until

DAEMONS = ("slurmctld", "slurmd")
#: Of this user alone, without munge; jobs are tracked by their parents.
CONFIG = """\
ClusterName=tests
SlurmctldHost={host}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
SlurmctldPort={control}
SlurmdPort={daemon}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerParameters=batch_sched_delay=0,sched_interval=1
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
ReturnToService=2
NodeName={host} CPUs=2 RealMemory=3000 State=UNKNOWN
PartitionName=main Nodes={host} Default=YES State=UP
"""


def is_installed() -> bool:
    return all(_daemon(name) for name in DAEMONS)


@contextmanager
def real(folder: Path) -> Iterator[dict[str, str]]:
    """The variables with which SLURM's commands find a cluster of this machine, which lasts as long as the context."""
    for each in ("state", "spool"):
        (folder / each).mkdir()
    host = socket.gethostname().partition(".")[0]
    ports = _free_ports()
    config = folder / "slurm.conf"
    config.write_text(
        CONFIG.format(host=host, user=getpass.getuser(), control=ports[0], daemon=ports[1], folder=folder)
    )
    variables = {"SLURM_CONF": str(config)}
    with ExitStack() as stack:
        for name in DAEMONS:
            log = stack.enter_context((folder / f"{name}.log").open("wb"))
            command = [_daemon(name) or "", "-D", "-f", str(config)]
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
            stack.callback(_end, process)
        wait_until(lambda: _says_idle(variables))
        yield variables
        subprocess.run(["scancel", "--me"], env=os.environ | variables, check=False)
        wait_until(lambda: not _ask(["squeue", "--noheader"], variables).strip())


@contextmanager
def stand_in(folder: Path) -> Iterator[dict[str, str]]:
    """The variables with which the stand-in's commands are found."""
    commands, state = folder / "commands", folder / "state"
    commands.mkdir()
    state.mkdir()
    program = Path(__file__).with_name("fake_slurm.py")
    for name in ("sbatch", "squeue", "scancel", "scontrol"):
        (commands / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" -S "{program}" {name} "$@"\n')
        (commands / name).chmod(0o755)
    yield {"PATH": f"{commands}{os.pathsep}{os.environ['PATH']}", "VDGS_TEST_SLURM": str(state)}
    for element in state.glob("*_*"):
        (element / "cancel").touch()


def _daemon(name: str) -> str | None:
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}{os.pathsep}/usr/sbin")


def _says_idle(variables: dict[str, str]) -> bool:
    return "idle" in _ask(["sinfo", "--noheader", "--format=%T"], variables)


def _ask(command: list[str], variables: dict[str, str]) -> str:
    return subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False).stdout


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGTERM)
    process.wait(PATIENCE_SECONDS)


def _free_ports() -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(2)]
        for each in sockets:
            each.bind(("", 0))
        return [each.getsockname()[1] for each in sockets]
