"""A process that waits at a moment chosen beforehand, so that a test can stop or kill it just there.

The moment is when the process is about to do something to a file (open, rename, remove) for the n-th time. An
environment variable says it: processes that the process starts wait there too (tests/support/startup/sitecustomize.py).
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import threading
from contextlib import suppress
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path

VARIABLE = "VDGS_TEST_PAUSE"
EVENTS = ("open", "os.rename", "os.remove")


@dataclass(frozen=True)
class Pause:
    """Wait at the `count`-th event of a file whose whole path is like `pattern` (fnmatch).

    Processes that wait are listed by number in the folder `waiting`. None waits any more once it holds a file `off`.
    """

    pattern: str
    count: int
    waiting: str

    def environment(self) -> dict[str, str]:
        """What a process needs to be told, and the processes that it starts."""
        startup = str(Path(__file__).parent / "startup")
        paths = [startup, str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        return {VARIABLE: json.dumps(asdict(self)), "PYTHONPATH": os.pathsep.join(filter(None, paths))}

    def processes(self) -> list[int]:
        """Those that wait, or did."""
        return [int(file.name) for file in Path(self.waiting).iterdir() if file.name.isdecimal()]

    def end(self, number: signal.Signals = signal.SIGUSR1) -> None:
        """Let all go on (or send them another signal), and none wait from now on."""
        (Path(self.waiting) / "off").touch()
        for process in self.processes():
            with suppress(ProcessLookupError):  # one that was killed while it waited
                os.kill(process, number)


def pause_where_asked() -> None:
    """Let this process wait as the environment says, if it does."""
    if VARIABLE not in os.environ:
        return
    pause = Pause(**json.loads(os.environ[VARIABLE]))
    moments = itertools.count(1)

    def look(event: str, details: tuple) -> None:
        if event not in EVENTS or threading.current_thread() is not threading.main_thread():
            return
        file = details[1 if event == "os.rename" else 0]
        if isinstance(file, str) and fnmatch(file, pause.pattern) and next(moments) == pause.count:
            _wait(Path(pause.waiting))

    sys.addaudithook(look)


def _wait(folder: Path) -> None:
    """Until a signal comes whose handler goes on: a request to stop, or that of `Pause.end`."""
    if not folder.exists() or (folder / "off").exists():
        return
    arrived, write = os.pipe()
    os.set_blocking(write, False)
    signal.set_wakeup_fd(write)  # a signal that comes before this process waits is not missed
    signal.signal(signal.SIGUSR1, lambda *_: None)
    (folder / str(os.getpid())).touch()
    try:
        os.read(arrived, 1)
    finally:  # the handler of another signal may raise
        signal.set_wakeup_fd(-1)
        # What went on for another signal may be about to end when that of `Pause.end` comes. An interpreter that ends
        # gives signals with handlers their default back, which kills; one that is ignored stays so.
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)
