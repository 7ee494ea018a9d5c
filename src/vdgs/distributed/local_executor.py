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
        self._oom_kills = oom_kill_count()

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

    def memory_ran_out(self) -> bool:
        """Whether the system has ended processes for want of memory since the last call."""
        before, self._oom_kills = self._oom_kills, oom_kill_count()
        return self._oom_kills > before


class _LocalAttempt:
    def __init__(self, process: TaskProcess, engine: _LocalEngine):
        self._process, self._engine = process, engine
        self.start_info = AttemptStarted(process.output_offset)
        self.request_stop, self.kill = process.terminate, process.kill

    def poll(self) -> AttemptResult | None:
        code = self._process.poll()
        if code is None:
            return None
        return AttemptResult(code, out_of_memory=code == -signal.SIGKILL and self._engine.memory_ran_out())
