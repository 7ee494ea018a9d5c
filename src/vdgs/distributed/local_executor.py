"""Tasks as processes of this machine, side by side, each continued from its own state if it crashes."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass

from vdgs.distributed.executor import Begun, End, Listener, Outcome, Task
from vdgs.distributed.scheduler import Policy, run_crew
from vdgs.distributed.task_process import Process, out_of_memory_kills


@dataclass(frozen=True)
class LocalExecutor(Policy):
    """Runs tasks in processes of this machine. A second Ctrl-C kills those that still run."""

    def run(self, tasks: Sequence[Task], listener: Listener) -> list[Outcome]:
        """As `Executor.run`."""
        return run_crew(tasks, _Processes(), self, listener)


class _Processes:
    """The engine: attempts that end with this process."""

    most_memory = None

    def __init__(self) -> None:
        self._memory_kills = out_of_memory_kills()

    def start(self, tasks: Sequence[tuple[Task, int]]) -> list[_LocalAttempt | OSError]:
        return [self._start(task, attempt) for task, attempt in tasks]

    def _start(self, task: Task, attempt: int) -> _LocalAttempt | OSError:
        try:
            return _LocalAttempt(Process(task.command, task.output, task.environment, attempt), self)
        except OSError as error:
            return error

    def find(self, _task: Task) -> None:
        """What a driver that died has left ends by itself (`parent`)."""

    def refresh(self) -> None:
        """`look` asks the system itself."""

    def memory_ran_out(self) -> bool:
        """Whether the system has ended processes for want of memory since this was last asked."""
        kills, before = out_of_memory_kills(), self._memory_kills
        self._memory_kills = kills
        return kills > before


class _LocalAttempt:
    def __init__(self, process: Process, engine: _Processes):
        self._process, self._engine = process, engine
        self.begun = Begun(process.output_from)

    def look(self) -> End | None:
        code = self._process.poll()
        if code is None:
            return None
        return End(code, out_of_memory=code == -signal.SIGKILL and self._engine.memory_ran_out())

    def ask_to_stop(self) -> None:
        self._process.terminate()

    def kill(self) -> None:
        self._process.kill()
