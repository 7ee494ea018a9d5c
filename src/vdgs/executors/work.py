"""Work of a stage in pieces: the folders that pieces keep, what they leave in them, and what they tell while at work.

    OUTPUT/pieces/KEY/NN/   of piece NN: status.json, output.log, a file for each of its items once it is done, each
                            whole or absent; what is there is not done again
    OUTPUT/pieces/KEY/slurm/   as in a run folder, where jobs of SLURM do the work

KEY tells what the work depends on: what was begun for another model or with other settings is never joined, nor found
by a driver that wants something else. All of it is removed once the pieces are joined. OUTPUT may be any folder of a
person's, with a `pieces` of its own in it: only what is known to be work of ours is ever removed.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from vdgs.errors import Interrupted, RunError, Stopped, VdgsError
from vdgs.executors.fitness import code_identity
from vdgs.memory.process import peak_memory_bytes
from vdgs.runs.locks import hold, is_locked
from vdgs.runs.stage_folder import StageFolder
from vdgs.runs.status import Status

#: The name of the folder of all pieces in the folder that the work is for.
PIECES = "pieces"
#: What the names of the folders of works look like (`PieceWork.of`).
_KEY = re.compile(r"[0-9a-f]{12}")
#: Seconds between two notes of how far a piece is.
STATUS_SECONDS = 1.0


def spans_of(items: int, least: int, most: int, pieces: int) -> tuple[range, ...]:
    """Items from 0, cut into spans of about equal length: so many `pieces` as long as none is shorter than `least` or
    longer than `most`. Nothing but the number of items decides, so that any driver cuts the same."""
    each = min(most, max(least, -(-items // pieces)))
    count = max(1, -(-items // each))
    ends = [items * place // count for place in range(count + 1)]
    return tuple(range(begin, end) for begin, end in pairwise(ends))


@dataclass(frozen=True)
class PieceWork:
    """Work for a folder, cut into pieces of items that are numbered from 0."""

    output: Path
    """The folder that the work is for."""
    key: str
    spans: tuple[range, ...]
    """The items of each piece."""

    @staticmethod
    def of(output: Path, depends_on: Any, spans: Sequence[range]) -> PieceWork:
        """The work whose results depend on these plain values, on its spans and on the code that does it."""
        told = json.dumps([code_identity(), depends_on, [[span.start, span.stop] for span in spans]])
        return PieceWork(output, hashlib.sha256(told.encode()).hexdigest()[:12], tuple(spans))

    @property
    def folder(self) -> Path:
        return self.output / PIECES / self.key

    def piece(self, index: int) -> StageFolder:
        return StageFolder(self.folder / f"{index:02d}")

    def span(self, index: int) -> range:
        """The items of a piece. Raises RunError for a piece that there is not."""
        if not 0 <= index < len(self.spans):
            raise RunError(f"--piece {index}: there are {len(self.spans)} pieces, numbered from 0.")
        return self.spans[index]

    def file(self, item: int, suffix: str = ".npz") -> Path:
        """What an item leaves."""
        index = next(index for index, span in enumerate(self.spans) if item in span)
        return self.piece(index).path / f"{item:06d}{suffix}"

    def is_done(self, index: int) -> bool:
        return self.piece(index).status().state == "done"

    @property
    def left(self) -> list[int]:
        """The pieces that are not done."""
        return [index for index in range(len(self.spans)) if not self.is_done(index)]

    def mark_queued(self) -> None:
        """Let the pieces that are left say that they wait, but for those that are at work."""
        for index in self.left:
            folder = self.piece(index)
            with suppress(RunError), folder.locked():
                if not self.is_done(index):
                    folder.set_status(Status("queued"))

    @property
    def peak_memory_bytes(self) -> int:
        """The most that a piece took."""
        return max(self.piece(index).status().peak_memory_bytes or 0 for index in range(len(self.spans)))


@contextmanager
def alone(output: Path, key: str | None = None) -> Iterator[None]:
    """Be the one process that works for a folder, but for pieces of the work with this `key` (`clear`).

    Raises RunError where another process works for it, or pieces of other work do without their driver.
    """
    with hold(output):
        clear(output, key)
        yield


def clear(output: Path, key: str | None = None) -> None:
    """Remove what pieces of other work than that with this `key` have left. Raises RunError where they are at work."""
    for work in (output / PIECES).glob("*"):
        if work.name != key and _is_work(work):
            _refuse_at_work(work)
            _remove(work)


def remove(work: PieceWork) -> None:
    """Remove what pieces have left, once they are joined."""
    _remove(work.folder)


def _remove(work: Path) -> None:
    """Remove the folder of a work, and that of all pieces once nothing is in it."""
    shutil.rmtree(work)
    with suppress(OSError):
        work.parent.rmdir()


def _is_work(folder: Path) -> bool:
    """Whether a folder holds pieces, whoever put what else beside it: it is named by a key, and it or a piece in it was
    locked once. One with nothing in it was made by a driver that ended at once, or is no loss."""
    if folder.is_symlink() or not folder.is_dir() or not _KEY.fullmatch(folder.name):
        return False
    locked = (folder / ".lock").exists() or any(folder.glob("*/.lock"))
    return locked or not any(folder.iterdir())


def _refuse_at_work(work: Path) -> None:
    if is_locked(work):
        raise RunError(f"{work}: another vdgs process gathers pieces there. Wait for it or stop it.")
    for folder in work.iterdir():
        if is_locked(folder):
            raise RunError(
                f"{folder}: a piece that an earlier command sent out is still at work there. Wait for it, or watch it "
                "again with that command (it stops with Ctrl-C)."
            )


@contextmanager
def at_work(folder: StageFolder, done: int, total: int) -> Iterator[Callable[[int], None]]:
    """Hold the folder of a piece and note there how far it is: to be told how many of its items are done.

    Raises Stopped after Ctrl-C or SIGTERM, and whatever is raised within; both are noted.
    """
    began, noted = time.monotonic(), 0.0
    before = done

    def status(state: str, why: str | None = None) -> Status:
        taken = time.monotonic() - began
        left = round((total - done) * taken / (done - before)) if done > before else None
        return Status(
            state, why, iteration=done, iterations=total, seconds=taken, seconds_left=left,
            peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip

    def tell(now: int) -> None:
        nonlocal done, noted
        done = now
        if time.monotonic() - noted > STATUS_SECONDS:
            noted = time.monotonic()
            folder.set_status(status("running"))

    with folder.locked():
        tell(done)
        try:
            yield tell
        except (KeyboardInterrupt, Interrupted) as error:
            folder.set_status(status("stopped"))
            raise Stopped(
                f"Stopped after {done} of {total}; what is done is saved. The same command continues."
            ) from error
        except VdgsError as error:
            folder.set_status(status("failed", str(error)))
            raise
        folder.set_status(status("done"))
