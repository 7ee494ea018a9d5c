"""Folders that processes hold, by a lock of the system on a file in them, which ends with the process."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vdgs.errors import RunError
from vdgs.system.atomic_files import disk_hint

#: The file in a folder that is locked.
LOCK_FILE = ".lock"
#: Attempts to take a lock, and seconds between them: `is_locked` holds it too, for a moment.
LOCK_ATTEMPTS, LOCK_SECONDS = 3, 0.02


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
def lock_folder(folder: Path, shared: bool = False) -> Iterator[None]:
    """Hold the lock of a folder, exclusive or `shared`; the folder is created if missing. Raises RunError if another
    process holds it, or the folder cannot be written."""
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # For reading and writing: NFS needs the one for shared locks and the other for exclusive ones.
        handle = (folder / LOCK_FILE).open("a+b")
    except OSError as error:
        raise RunError(f"{folder}: cannot be written ({error.strerror}). {disk_hint(error)}.") from error
    with handle:
        for attempt in range(LOCK_ATTEMPTS):
            try:
                fcntl.flock(handle, kind | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if attempt + 1 == LOCK_ATTEMPTS:
                    problem = "another vdgs process works on this run. Wait for it or stop it."
                    raise RunError(f"{folder}: {problem}") from error
                time.sleep(LOCK_SECONDS)
            except OSError as error:
                raise RunError(
                    f"{folder}: its file system locks no files ({error.strerror}). Mount it with locks (NFS 4; Lustre: "
                    "-o flock), or choose a folder elsewhere."
                ) from error
        yield
