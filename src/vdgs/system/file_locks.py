"""Folders that processes hold, by a lock of the system on a file in them, which ends with the process."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from vdgs.errors import RunError
from vdgs.system.atomic_files import disk_hint
from vdgs.system.stop_signals import check_stop_requested

#: The file in a folder that is locked.
LOCK_FILE = ".lock"
#: Attempts to take a lock, and seconds between them: `is_locked` holds it too, for a moment.
LOCK_ATTEMPTS, LOCK_SECONDS = 3, 0.02
#: Seconds between attempts of a process that waits for another one.
WAIT_SECONDS = 0.5


def is_locked(folder: Path) -> bool:
    """Whether a process holds the exclusive lock of a folder. Creates nothing. Raises OSError where the file system has
    no locks."""
    try:
        handle = (folder / LOCK_FILE).open("rb")
    except OSError:
        return False
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def is_known_locked(folder: Path) -> bool:
    """As `is_locked`, but False where the file system has no locks: for readers."""
    try:
        return is_locked(folder)
    except OSError:  # Lustre without -o flock, some FUSE file systems
        return False


@contextmanager
def lock_folder(folder: Path, shared: bool = False, on_wait: Callable[[], object] | None = None) -> Iterator[None]:
    """Hold the lock of a folder, exclusive or `shared`; the folder is created if missing. Raises RunError if another
    process holds it, or the folder cannot be written. With `on_wait` another process is waited for, after that was
    called once; Interrupted where a stop is asked for meanwhile."""
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # For reading and writing: NFS needs the one for shared locks and the other for exclusive ones.
        handle = (folder / LOCK_FILE).open("a+b")
    except OSError as error:
        raise RunError(f"{folder}: cannot be written ({error.strerror}). {disk_hint(error)}.") from error
    with handle:
        attempts = 0
        while not _is_taken(handle, kind, folder):
            attempts += 1
            if attempts < LOCK_ATTEMPTS:
                time.sleep(LOCK_SECONDS)
                continue
            if on_wait is None:
                raise RunError(f"{folder}: another vdgs process works on this run. Wait for it or stop it.")
            if attempts == LOCK_ATTEMPTS:
                on_wait()
            check_stop_requested()
            time.sleep(WAIT_SECONDS)
        yield


def _is_taken(handle: BinaryIO, kind: int, folder: Path) -> bool:
    """Whether this process has the lock now. Raises RunError where the file system has no locks."""
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise RunError(
            f"{folder}: its file system locks no files ({error.strerror}). Mount it with locks (NFS 4; Lustre: "
            "-o flock), or choose a folder elsewhere."
        ) from error
    return True
