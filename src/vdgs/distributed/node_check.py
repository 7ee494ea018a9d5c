"""Whether a machine can work on a run: it sees the same files, runs the same vdgs, and its locks hold for the others.

Questions and answers are plain values, so that a machine without vdgs can be asked too.
"""

from __future__ import annotations

import hashlib
import os
import platform
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from uuid import uuid4

from vdgs import __version__
from vdgs.captures.capture import View
from vdgs.system.atomic_files import write_text
from vdgs.system.documents import FitnessAnswer, FitnessQuestion
from vdgs.system.file_locks import is_locked, lock_folder

#: How many files are compared by their size, at most (the first, the last and some between).
MAX_CHECKED_FILES = 8
#: Where Linux lists the instruction sets of its processors, and those that decide which kernels run, the best first.
CPUINFO_FILE, INSTRUCTION_SETS = Path("/proc/cpuinfo"), ("avx512f", "avx2")
_NO_LOCKS = (
    "{}: locks of files (flock) {}. Mount that file system with them (NFS 4; Lustre: -o flock), or two machines may "
    "write the same files"
)


@dataclass(frozen=True)
class NodeRequirements:
    """What a machine must see to work on a run."""

    folder: Path
    """The run folder: must be the same one, and writable."""
    files: Sequence[Path]
    """Images and models that must be there, of the size that they have here."""

    def to_dict(self, held: Path | None = None) -> FitnessQuestion:
        """The question as plain values; `held` is a folder that this process has locked."""
        step = max(1, -(-len(self.files) // MAX_CHECKED_FILES))
        chosen = [*self.files[::step], *self.files[-1:]]
        return {
            "folder": str(self.folder), "files": [(str(file), _size(file)) for file in chosen],
            "code": code_digest(), "version": __version__, "held": None if held is None else str(held),
        }  # fmt: skip

    @contextmanager
    def with_lock_probe(self) -> Iterator[FitnessQuestion]:
        """The question while this process locks a folder in the run folder, so that others can be asked to see that."""
        held = self.folder / f".fitness-{uuid4().hex}"
        try:
            with lock_folder(held):
                write_text(held / "here", held.name)
                yield self.to_dict(held)
        finally:
            for file in ("here", ".lock"):
                (held / file).unlink(missing_ok=True)
            held.rmdir()


def image_and_mask_files(views: Sequence[View]) -> list[Path]:
    """The image files of views, and their masks where they have any."""
    return [path for view in views for path in (view.image_path, view.mask_path) if path is not None]


def check_node(question: FitnessQuestion) -> FitnessAnswer:
    """This machine's answer: its `node`, the `processor`'s instructions, and the `problems` that it sees, in words."""
    problems = [*_folder_problems(question), *_file_problems(question["files"]), *_code_problems(question)]
    return {"node": socket.gethostname(), "processor": cpu_instruction_set(), "problems": problems}


@cache
def code_digest() -> str:
    """A digest of the Python files of this vdgs."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _folder_problems(question: FitnessQuestion) -> list[str]:
    folder, held = Path(question["folder"]), None if question["held"] is None else Path(question["held"])
    remedy = "All nodes must share the file system that it lies on"
    if not folder.is_dir():
        return [f"there is no {folder}. {remedy}"]
    if held is not None and not (held / "here").is_file():
        return [f"{folder} is another folder there, of the same name. {remedy}"]
    if not os.access(folder, os.W_OK):
        return [f"{folder} cannot be written there"]
    try:
        return [] if held is None or is_locked(held) else [_NO_LOCKS.format(folder, "reach no other node")]
    except OSError as error:
        return [_NO_LOCKS.format(folder, f"do not work there ({error.strerror})")]


def _file_problems(files: Sequence[tuple[str, int]]) -> list[str]:
    for name, size in files:
        if (size_there := _size(Path(name))) < 0:
            return [f"there is no {name}, or it cannot be read. Photographs must lie where all nodes see them"]
        if size_there != size:
            return [f"{name} has {size_there:,} bytes there and {size:,} here: it is another file"]
    return []


def _code_problems(question: FitnessQuestion) -> list[str]:
    if question["version"] != __version__:
        return [f"it has vdgs {__version__}, this machine {question['version']}. Install the same on all"]
    if question["code"] != code_digest():
        return [f"its vdgs {__version__} is not the same code as this machine's. Install the same on all"]
    return []


def _size(file: Path) -> int:
    """Bytes; -1 of a file that is not there or cannot be read."""
    try:
        return file.stat().st_size if os.access(file, os.R_OK) else -1
    except OSError:
        return -1


def cpu_instruction_set() -> str:
    """The instruction set that decides which kernels run here; without one of these, the machine's kind."""
    try:
        flags = CPUINFO_FILE.read_text(encoding="ascii", errors="replace")
    except OSError:
        return platform.machine()
    return next((name for name in INSTRUCTION_SETS if f" {name} " in flags), platform.machine())
