"""One attempt at a command as a process of the machine that this runs on, its output appended to a file."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from vdgs.distributed.executor import PARENT_PID_VARIABLE
from vdgs.system.quoting import shell_line

#: Bytes of output that are read, and lines that are shown.
TAIL_BYTES, TAIL_LINES = 1 << 16, 12
#: How the command line begins the message of an error (`system.exit_codes`).
ERROR_PREFIX = re.compile(r"vdgs [\w-]+: ")
#: Colors and cursor movements; other control characters.
ANSI_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[ -/]*[@-~]")
CONTROL_CHARACTERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def stop_when_parent_dies(poll_seconds: float = 1.0) -> threading.Thread | None:
    """Send this process SIGTERM, once, when the driver that started it is gone. Returns the watching thread.

    None where no driver did. The variable is removed: processes that this one starts have another parent. Polling,
    unlike PR_SET_PDEATHSIG, works on every POSIX system and does not end the task with the driver's thread.
    """
    try:
        parent = int(os.environ.pop(PARENT_PID_VARIABLE, ""))
    except ValueError:
        return None
    watch = threading.Thread(target=_watch_parent, args=(parent, poll_seconds), name="parent", daemon=True)
    watch.start()
    return watch


def _watch_parent(parent: int, poll_seconds: float) -> None:
    while os.getppid() == parent:  # an orphan is adopted by another process
        time.sleep(poll_seconds)
    os.kill(os.getpid(), signal.SIGTERM)


def tail_lines(output: Path, start: int = 0) -> list[str]:
    """The last lines after byte `start` that are not empty; none if the file cannot be read."""
    try:
        with output.open("rb") as handle:
            end = handle.seek(0, 2)
            handle.seek(max(start, end - TAIL_BYTES))
            text = handle.read(TAIL_BYTES).decode(errors="replace")
    except OSError:
        return []
    # A carriage return overwrites its line: what follows the last one is what a person saw.
    lines = [line.rstrip("\r\n").rpartition("\r")[2] for line in text.split("\n")]
    clean = [CONTROL_CHARACTERS.sub("", ANSI_ESCAPES.sub("", line)).rstrip() for line in lines]
    return [line for line in clean if line][-TAIL_LINES:]


def error_message(output: Path, start: int = 0) -> str:
    """The message that the command line ended with, else the last line; empty if there is no output."""
    lines = tail_lines(output, start)
    for index in reversed(range(len(lines))):
        if ERROR_PREFIX.match(lines[index]):
            return "\n".join([ERROR_PREFIX.sub("", lines[index]), *lines[index + 1 :]])
    return lines[-1] if lines else ""


class TaskProcess:
    """A command in a session of its own, so that the terminal's Ctrl-C reaches its driver alone."""

    def __init__(self, command: Sequence[str], output: Path, environment: Mapping[str, str], attempt: int):
        """Start the command. Raises OSError if its output cannot be written or there is no such command."""
        output.parent.mkdir(parents=True, exist_ok=True)
        heading = f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} attempt {attempt}: {shell_line(command)}"
        variables = {"PYTHONUNBUFFERED": "1", **environment, PARENT_PID_VARIABLE: str(os.getpid())}
        with output.open("ab") as file:
            file.write(f"{heading}\n".encode())
            file.flush()
            #: Where the output of this attempt begins.
            self.output_offset = file.tell()
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
                env={**os.environ, **variables}, start_new_session=True,
            )  # fmt: skip
        self._process = process
        #: The exit code, None while it runs; wait for the end; ask it to save and end.
        self.poll, self.wait, self.terminate = process.poll, process.wait, process.terminate

    def kill(self) -> None:
        """End the process and whatever it started (its session's group)."""
        if self._process.poll() is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)


def oom_kill_count() -> int:
    """How many processes the system has ended so far for want of memory; 0 where it does not say."""
    try:
        counters = Path("/proc/vmstat").read_text(encoding="ascii")
    except (OSError, ValueError):
        return 0
    return next((int(line.split()[1]) for line in counters.splitlines() if line.startswith("oom_kill ")), 0)
