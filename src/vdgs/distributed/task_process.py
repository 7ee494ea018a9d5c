"""One attempt at a command as a process of the machine that this runs on, its output appended to a file."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from vdgs.distributed.parent import PARENT


class Process:
    """A command in a session of its own, so that the terminal's Ctrl-C reaches its driver alone."""

    def __init__(self, command: Sequence[str], output: Path, environment: Mapping[str, str], attempt: int):
        """Start the command. Raises OSError if its output cannot be written or there is no such command."""
        output.parent.mkdir(parents=True, exist_ok=True)
        heading = f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} attempt {attempt}: {shlex.join(command)}"
        variables = {"PYTHONUNBUFFERED": "1", **environment, PARENT: str(os.getpid())}
        with output.open("ab") as file:
            file.write(f"{heading}\n".encode())
            file.flush()
            #: Where the output of this attempt begins.
            self.output_from = file.tell()
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                env={**os.environ, **variables}, start_new_session=True,
            )  # fmt: skip

    def poll(self) -> int | None:
        """The exit code; None while it runs."""
        return self._process.poll()

    def wait(self) -> int:
        """Wait for the end; the exit code."""
        return self._process.wait()

    def terminate(self) -> None:
        """Ask it to save and end."""
        self._process.terminate()

    def kill(self) -> None:
        """End the process and whatever it started (its session's group)."""
        if self._process.poll() is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)


def out_of_memory_kills() -> int:
    """How many processes the system has ended so far for want of memory; 0 where it does not say."""
    try:
        counters = Path("/proc/vmstat").read_text(encoding="ascii")
    except (OSError, ValueError):
        return 0
    return next((int(line.split()[1]) for line in counters.splitlines() if line.startswith("oom_kill ")), 0)
