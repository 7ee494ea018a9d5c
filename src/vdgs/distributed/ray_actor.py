"""The actor on a Ray node that runs one command for a driver and returns how it ends.

It is a detached actor, known by name, so that a driver that was started again finds it. Its command ends with it
(`task_process.stop_when_parent_dies`). Where no driver collects the result it exits: the command can be repeated.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from vdgs.distributed.executor import AttemptResult, AttemptStarted
from vdgs.distributed.node_check import check_node
from vdgs.distributed.task_process import TaskProcess, oom_kill_count
from vdgs.system.documents import FitnessQuestion

#: Seconds that the result of a command waits for a driver.
RESULT_TIMEOUT_SECONDS = 300.0
#: A worker whose node is lost kills its children, then ends itself. A killed command is reported only after so many
#: seconds, so that the driver hears of the node instead.
KILLED_WITH_WORKER_SECONDS = 2.0


@dataclass(frozen=True, kw_only=True)
class RayTaskSpec:
    """What an actor is to run, in plain values."""

    command: tuple[str, ...]
    output: str
    environment: Mapping[str, str]
    attempt: int
    python: str
    """The driver's interpreter; a node takes its own instead."""
    requirements: FitnessQuestion
    """What the node must see: nodes join late."""


@dataclass(frozen=True)
class NodeRejected:
    """The node cannot work on the run."""

    node: str
    node_id: str
    """What Ray calls the node."""
    reason: str


class RayTaskActor:
    """Runs one command. Its methods are called from several threads of the actor."""

    def __init__(self, spec: RayTaskSpec, result_timeout_seconds: float = RESULT_TIMEOUT_SECONDS):
        self._spec, self._result_timeout_seconds = spec, result_timeout_seconds
        self._process: TaskProcess | None = None
        self._stop_requested = False
        self._lock = threading.Lock()
        self._oom_kills = oom_kill_count()

    def begin(self) -> AttemptStarted | NodeRejected:
        """Start the command, unless it was started; where it runs. Raises OSError as `TaskProcess`."""
        with self._lock:
            spec, answer = self._spec, check_node(self._spec.requirements)
            if answer["problems"]:
                import ray

                node_id = str(ray.get_runtime_context().get_node_id())
                return NodeRejected(answer["node"], node_id, answer["problems"][0])
            if self._process is None:
                command = [sys.executable if spec.command[0] == spec.python else spec.command[0], *spec.command[1:]]
                self._process = TaskProcess(command, Path(spec.output), spec.environment, spec.attempt)
            return AttemptStarted(self._process.output_offset, answer["node"])

    def end(self) -> AttemptResult | None:
        """Wait for the end of the command; None if it was never started."""
        with self._lock:
            process = self._process
        if process is None:
            return None
        code = process.wait()
        threading.Thread(target=self._exit_unless_collected, daemon=True).start()
        if code != -signal.SIGKILL:
            return AttemptResult(code)
        time.sleep(KILLED_WITH_WORKER_SECONDS)
        return AttemptResult(code, out_of_memory=oom_kill_count() > self._oom_kills)

    def stop(self) -> None:
        """Ask the command to save and end, once."""
        if self._process is not None and not self._stop_requested:
            self._stop_requested = True
            self._process.terminate()

    def kill(self) -> None:
        """End the command at once."""
        if self._process is not None:
            self._process.kill()

    def _exit_unless_collected(self) -> None:
        threading.Event().wait(self._result_timeout_seconds)
        os._exit(0)
