"""What vdgs starts, forked: processes of their own, to be signalled and killed, without the seconds of importing.

A process that has done nothing yet forks from each command and waits for orders; what the command would start is forked
from that one. It ends with the command, and then its children notice that their driver is gone.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from types import SimpleNamespace
from typing import IO

from vdgs.distributed.task_process import PARENT_PID_VARIABLE

#: Seconds between two looks at a process that is waited for.
GLANCE_SECONDS = 0.01


def fork_tasks() -> None:
    """Let this process, and those that it starts so, fork what they would start. Called before anything else."""
    here, there = multiprocessing.Pipe()
    if os.fork() == 0:
        here.close()
        _serve(there)
    there.close()

    class Forked(_Forked):
        orders = here

    from vdgs.distributed import task_process

    task_process.subprocess = SimpleNamespace(Popen=Forked, DEVNULL=None, STDOUT=None)  # type: ignore[assignment]


def module_of(command: Sequence[str]) -> tuple[str, list[str]]:
    """The module that a command of `child_python` runs, and its arguments."""
    assert command[0] == sys.executable
    module = command.index("-m") + 1
    return command[module], list(command[module + 1 :])


def start_tasks() -> None:
    """Let this process start what it starts, as people's do."""
    from vdgs.distributed import task_process

    task_process.subprocess = subprocess  # type: ignore[attr-defined]


class _Forked:
    """What is asked of `subprocess.Popen`."""

    orders: Connection

    def __init__(self, command: Sequence[str], stdout: IO[bytes], env: Mapping[str, str], **_options: object):
        module, arguments = module_of(command)
        self._code: int | None = None
        self.pid = int(self._ask((module, arguments, stdout.name, dict(env))) or 0)

    def poll(self) -> int | None:
        if self._code is None:
            self._code = self._ask(self.pid)
        return self._code

    def wait(self) -> int:
        began = time.monotonic()
        while (code := self.poll()) is None:
            time.sleep(max(GLANCE_SECONDS, (time.monotonic() - began) / 50))
        return code

    def terminate(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGTERM)

    def _ask(self, order: object) -> int | None:
        self.orders.send(order)
        answer = self.orders.recv()
        return None if answer is None else int(answer)


def _serve(orders: Connection) -> None:
    """Fork what is ordered; tell the exit code (None while it runs) of a child that is asked for."""
    children = dict[int, BaseProcess]()
    while True:
        try:
            order = orders.recv()
        except (EOFError, OSError, KeyboardInterrupt):
            os._exit(0)
        if isinstance(order, int):
            orders.send(children[order].exitcode)
            continue
        child = multiprocessing.get_context("fork").Process(target=_become, args=(orders, *order))
        child.start()
        assert child.pid is not None
        children[child.pid] = child
        orders.send(child.pid)


def _become(orders: Connection, module: str, arguments: list[str], output: str, environment: Mapping[str, str]) -> None:
    """Be what `python -m module` would be, in a session of its own."""
    orders.close()
    os.setsid()
    os.dup2(os.open(output, os.O_WRONLY | os.O_APPEND), 1)
    os.dup2(1, 2)
    os.environ.clear()
    os.environ.update(environment | {PARENT_PID_VARIABLE: str(os.getppid())})
    fork_tasks()
    sys.exit(importlib.import_module(module).main(arguments))
