"""Tasks as processes of this machine, side by side, each continued from its own state if it crashes."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass

from vdgs.distributed.executor import AttemptResult, AttemptStarted, Task, TaskListener, TaskResult
from vdgs.distributed.scheduler import ExecutionPolicy, run_tasks
from vdgs.distributed.task_process import TaskProcess, oom_kill_count


@dataclass(frozen=True)
class LocalExecutor(ExecutionPolicy):
    """Runs tasks in processes of this machine. A second Ctrl-C kills those that still run."""

    def run(self, tasks: Sequence[Task], listener: TaskListener) -> list[TaskResult]:
        """As `Executor.run`."""
        return run_tasks(tasks, _LocalEngine(), self, listener)


class _LocalEngine:
    """Its attempts end with this process: none is found running (`task_process.stop_when_parent_dies`)."""

    max_memory_bytes = None

    def __init__(self) -> None:
        #: What the system has counted, and how many of these kills no task has accounted for.
        self._oom_kills, self._unclaimed_kills = oom_kill_count(), 0

    def start(self, tasks: Sequence[tuple[Task, int]]) -> list[_LocalAttempt | OSError]:
        return [self._start(task, attempt) for task, attempt in tasks]

    def _start(self, task: Task, attempt: int) -> _LocalAttempt | OSError:
        try:
            return _LocalAttempt(TaskProcess(task.command, task.output, task.environment, attempt), self)
        except OSError as error:
            return error

    def find_running(self, _task: Task) -> None:
        return None

    def refresh(self) -> None:
        """`poll` asks the system itself."""

    def claim_memory_kill(self) -> bool:
        """Whether a task that was killed was so for want of memory: each takes one of the kills that the system counts,
        which it does before the process ends. Several may end between two polls."""
        before, self._oom_kills = self._oom_kills, oom_kill_count()
        self._unclaimed_kills += max(0, self._oom_kills - before)
        if not self._unclaimed_kills:
            return False
        self._unclaimed_kills -= 1
        return True


class _LocalAttempt:
    def __init__(self, process: TaskProcess, engine: _LocalEngine):
        self._process, self._engine = process, engine
        self.start_info = AttemptStarted(process.output_offset)
        self.request_stop, self.kill = process.terminate, process.kill

    def poll(self) -> AttemptResult | None:
        code = self._process.poll()
        if code is None:
            return None
        return AttemptResult(code, out_of_memory=code == -signal.SIGKILL and self._engine.claim_memory_kill())
