"""The folders of jobs: who works there, and what is removed (`sharded_job` says what lies where).

OUTPUT may be any folder of a person's, with `shards` of its own in it: only what is known to be a job is ever removed.
"""

from __future__ import annotations

import re
import shutil
from contextlib import suppress
from pathlib import Path

from vdgs.errors import RunError
from vdgs.system.file_locks import LOCK_FILE, is_locked

#: The name of the folder of all jobs in the folder that they are for.
SHARDS = "shards"
#: The names of the folders of jobs (`ShardedJob.create`).
_KEY = re.compile(r"[0-9a-f]{12}")


def clear(output: Path, key: str | None = None) -> None:
    """Remove what shards of other jobs than that with this `key` have left. Raises RunError where they are at work."""
    for job in (output / SHARDS).glob("*"):
        if job.name == key or not _is_job(job):
            continue
        if is_locked(job):
            raise RunError(f"{job}: another vdgs process gathers shards there. Wait for it or stop it.")
        for folder in job.iterdir():
            if is_locked(folder):
                raise RunError(
                    f"{folder}: a shard that an earlier command sent out is still at work there. Wait for it, or watch "
                    "it again with that command (it stops with Ctrl-C)."
                )
        remove(job)


def remove(job: Path) -> None:
    """Remove the folder of a job that no process of this machine holds, and that of all jobs once nothing is in it.

    What cannot be removed stays for the next `clear`: the work that lay there is done.
    """
    with suppress(OSError):
        empty(job)
        if not any(each.name != LOCK_FILE for each in job.iterdir()):  # else the lock says that it is a job's
            (job / LOCK_FILE).unlink(missing_ok=True)
            job.rmdir()
            job.parent.rmdir()


def empty(job: Path) -> None:
    """Remove what is in the folder of a job but its lock: NFS keeps a file that is open, in a folder which then cannot
    be removed either."""
    for each in job.iterdir():
        if each.name == LOCK_FILE:
            continue
        if each.is_dir() and not each.is_symlink():
            shutil.rmtree(each, ignore_errors=True)
        else:
            with suppress(OSError):
                each.unlink()


def _is_job(folder: Path) -> bool:
    """Whether a folder is a job's, whoever put what else beside it: its name is a key, and it or a shard in it was
    locked once. An empty one was made by a driver that ended at once, or is no loss."""
    if folder.is_symlink() or not folder.is_dir() or not _KEY.fullmatch(folder.name):
        return False
    locked = (folder / LOCK_FILE).exists() or any(folder.glob(f"*/{LOCK_FILE}"))
    return locked or not any(folder.iterdir())
