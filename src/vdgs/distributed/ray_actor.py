"""What runs on a Ray node in the place of a driver: it keeps one command and tells how that ends.

It is a detached actor, known by name, so that a driver that was started again finds it. Its command ends with it
(`parent`). When nobody comes for the end, it goes: the command can be repeated.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vdgs.distributed.executor import AttemptResult, AttemptStarted
from vdgs.distributed.node_check import check_node
from vdgs.distributed.task_process import TaskProcess, oom_kill_count
from vdgs.system.documents import FitnessQuestion

#: Seconds that the end of a command waits for a driver.
RESULT_TIMEOUT_SECONDS = 300.0


@dataclass(frozen=True, kw_only=True)
class RayTaskSpec:
    """What a keeper is to run, in plain values."""

    command: tuple[str, ...]
    output: str
    environment: Mapping[str, str]
    attempt: int
    python: str
    """The driver's interpreter; a node takes its own instead."""
    requirements: FitnessQuestion
    """What the node must see (`fitness`): nodes join late."""


@dataclass(frozen=True)
class NodeRejected:
    """The node cannot work on the run."""

    node: str
    node_id: str
    """What Ray calls the node."""
    reason: str


class RayTaskActor:
    """Runs one command. Its methods are called from several threads of the actor."""

    def __init__(self, order: RayTaskSpec, collect_seconds: float = RESULT_TIMEOUT_SECONDS):
        self._order, self._collect_seconds = order, collect_seconds
        self._process: TaskProcess | None = None
        self._asked = False
        self._lock = threading.Lock()
        self._memory_kills = oom_kill_count()

    def begin(self) -> AttemptStarted | NodeRejected:
        """Start the command, unless it was started; where it runs. Raises OSError as `TaskProcess`."""
        with self._lock:
            answer = check_node(self._order.requirements)
            if answer["problems"]:
                return NodeRejected(answer["node"], _node_id(), answer["problems"][0])
            if self._process is None:
                order = self._order
                command = [sys.executable if order.command[0] == order.python else order.command[0], *order.command[1:]]
                self._process = TaskProcess(command, Path(order.output), order.environment, order.attempt)
            return AttemptStarted(self._process.output_offset, answer["node"])

    def end(self) -> AttemptResult | None:
        """Wait for the end of the command; None if it was never started."""
        with self._lock:
            process = self._process
        if process is None:
            return None
        code = process.wait()
        threading.Thread(target=self._exit_unless_collected, daemon=True).start()
        killed = code == -signal.SIGKILL and oom_kill_count() > self._memory_kills
        return AttemptResult(code, out_of_memory=killed)

    def stop(self) -> None:
        """Ask the command to save and end, once."""
        if self._process is not None and not self._asked:
            self._asked = True
            self._process.terminate()

    def kill(self) -> None:
        """End the command at once."""
        if self._process is not None:
            self._process.kill()

    def _exit_unless_collected(self) -> None:
        threading.Event().wait(self._collect_seconds)
        os._exit(0)


def _node_id() -> str:
    import ray

    return str(ray.get_runtime_context().get_node_id())
