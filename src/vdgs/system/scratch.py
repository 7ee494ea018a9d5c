"""Folders and files that stand beside an output while it is written, and what killed processes leave of them.

A scratch folder holds a locked file as long as its process lives, on whichever machine. Temporary files carry a mark of
their machine and the number of their process (`atomic_files.process_mark`): those of another machine stay for a while.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from vdgs.system.atomic_files import explain_disk_errors, host_mark

#: How the names of scratch folders end, and their file that is locked.
ENDING, LOCK = ".scratch", ".lock"
#: Temporary files of `write_atomic` and of films.
_TEMPORARY = re.compile(r"(?:^|\.)([0-9a-f]{6})-([0-9]+)\.(?:tmp|partial\.mp4)$")
#: A scratch folder without its file may just be made, for so many seconds.
_YOUNG_SECONDS = 60.0
#: A temporary file of another machine to which nothing came for so many seconds is not written to any more (choice).
QUIET_SECONDS = 600.0


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """A folder beside `path` for what waits while it is written; it goes when the context ends."""
    with explain_disk_errors(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.", suffix=ENDING))
    try:
        with (folder / LOCK).open("a+b") as handle:
            with suppress(OSError):  # a file system without locks: what is left there stays
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def nearest_existing(path: Path) -> Path:
    """An absolute path itself where it is there, else the innermost of its folders that is."""
    return next(each for each in (path, *path.parents) if each.exists())


def check_takes_files(folder: Path) -> None:
    """Raise VdgsError, before long work, where no file can be made in a folder that is there or will be created."""
    with explain_disk_errors(folder), tempfile.TemporaryFile(dir=nearest_existing(folder.absolute())):
        pass


def leftovers(path: Path) -> list[Path]:
    """Scratch folders and temporary files of `path` whose processes are gone."""
    try:
        entries = sorted(path.parent.iterdir())
    except OSError:
        return []
    start = f".{path.name}."
    return [each for each in entries if each.name.startswith(start) and _is_left(each, each.name[len(start) :])]


def _is_left(entry: Path, rest: str) -> bool:
    if rest.endswith(ENDING) and entry.is_dir() and not entry.is_symlink():
        return not _is_held(entry)
    found = _TEMPORARY.search(rest)
    if found is None or not entry.is_file():
        return False
    return not psutil.pid_exists(int(found[2])) if found[1] == host_mark() else _is_quiet(entry)


def _is_quiet(file: Path) -> bool:
    with suppress(OSError):  # gone: it took its place
        return time.time() - file.stat().st_mtime > QUIET_SECONDS
    return False


def _is_held(folder: Path) -> bool:
    try:
        with (folder / LOCK).open("rb") as handle:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        with suppress(OSError):
            return time.time() - folder.stat().st_mtime < _YOUNG_SECONDS
        return True
    except OSError:  # held, or where no files can be locked
        return True
    return False


def remove_leftovers(path: Path) -> list[Path]:
    """Remove what killed processes left of `path`; returns what was there. Nothing else is touched."""
    found = leftovers(path)
    for each in found:
        if each.is_dir():
            shutil.rmtree(each, ignore_errors=True)
        else:
            with suppress(OSError):
                os.unlink(each)
    return found
