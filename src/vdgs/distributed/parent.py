"""The process of a task ends with the process that started it, even if that one was killed without a word."""

from __future__ import annotations

import os
import signal
import threading
import time

#: Environment variable with the process id of the driver; set for each task that a driver starts.
PARENT = "VDGS_PARENT"


def stop_when_parent_dies(poll_seconds: float = 1.0) -> threading.Thread | None:
    """Send this process SIGTERM, once, when the driver that started it is gone. Returns the watching thread.

    Does nothing (None) where no driver did. The variable is removed, so that processes which this one starts do not
    take its parent for theirs. Polling is enough and, unlike PR_SET_PDEATHSIG, works on every POSIX system, needs no
    code between fork and exec, and does not end the task with the driver's thread.
    """
    try:
        parent = int(os.environ.pop(PARENT, ""))
    except ValueError:
        return None
    watch = threading.Thread(target=_watch, args=(parent, poll_seconds), name="parent", daemon=True)
    watch.start()
    return watch


def _watch(parent: int, poll_seconds: float) -> None:
    while os.getppid() == parent:  # an orphan is adopted by another process
        time.sleep(poll_seconds)
    os.kill(os.getpid(), signal.SIGTERM)
