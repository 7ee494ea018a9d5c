"""The work folder of a reconstruction: which steps are done, for which photographs and settings; calls into COLMAP."""

from __future__ import annotations

import json
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from rich.console import Console

from vdgs import __version__
from vdgs.captures.reconstruction import PROGRESS_FILE, SFM_STAGE, STEPS_FILE
from vdgs.errors import CaptureError, VdgsError
from vdgs.system.atomic_files import is_disk_full, read_json_or_empty, write_json
from vdgs.system.console import make_progress_bar
from vdgs.system.cpp_exceptions import catch_in_threads
from vdgs.system.lazy_pycolmap import pycolmap
from vdgs.system.step_progress import StepProgress, StepRecord
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import data_size, rough_duration

Result = TypeVar("Result")
#: The steps that are counted, in their order.
SfmStep = Literal["frames", "features", "matching", "mapping", "writing"]
SFM_STEPS: tuple[SfmStep, ...] = get_args(SfmStep)
#: What is counted of steps that do not count photographs.
_UNITS = {"frames": "seconds", "matching": "pairs"}
#: Seconds between two looks whether a person asked to stop.
_POLL_SECONDS = 0.2
#: Work that takes fewer seconds needs no lines about how far it is.
_MIN_LOG_SECONDS = 30.0
#: What SQLite and the system say of a disk that is full.
_FULL_DISK = re.compile(r"disk is full|disk I/O|No space left")
#: What stands behind the key of a step that was begun.
_BY = " by vdgs "
_VERSION = f"{_BY}{__version__}"


@dataclass(frozen=True)
class Workspace:
    """OUTPUT/work: links to the photographs, COLMAP's database, models, and what is done."""

    path: Path

    @property
    def images(self) -> Path:
        """Upright photographs by their names in the capture: links, or copies of those that lay on their side."""
        return self.path / "photographs"

    @property
    def masks(self) -> Path:
        """Masks of upright photographs, as COLMAP names them."""
        return self.path / "masks"

    def mask(self, name: str) -> Path:
        """Where the mask of a photograph is, if it has one."""
        return self.masks / f"{name}.png"

    @property
    def database(self) -> Path:
        return self.path / "database.db"

    @property
    def progress_file(self) -> Path:
        """How far the present step is."""
        return self.path / PROGRESS_FILE

    @property
    def expected_file(self) -> Path:
        """The seconds that each step takes, by estimate."""
        return self.path / "expected.json"

    @property
    def models(self) -> Path:
        return self.path / "models"

    @property
    def models_aside(self) -> Path:
        """Models of a first run of the mapper, while a second one may make better ones."""
        return self.path / "loose"

    @property
    def models_fitted(self) -> Path:
        """Models whose focal length was fitted, while others are made with it held."""
        return self.path / "fitted"

    @property
    def fisheyes_file(self) -> Path:
        """The cameras that are fisheyes as the photographs tell, while no tag says it."""
        return self.path / "fisheyes.json"

    @property
    def snapshots(self) -> Path:
        """Where the mapper writes what it has from time to time; whole only once it goes on."""
        return self.path / "snapshots"

    @property
    def saved_snapshots(self) -> Path:
        """Whole models that mapping goes on from, by how many photographs they place."""
        return self.path / "kept"

    def is_done(self, step: str, key: str) -> bool:
        """Whether a step is finished for these photographs and settings, by whatever version of vdgs."""
        return self._steps("done").get(step) == key

    def is_begun(self, step: str, key: str) -> bool:
        """Whether what there is of a step was made for these photographs and settings, by this version: parts that two
        versions made are not mixed."""
        return self._steps("begun").get(step) == f"{key}{_VERSION}"

    def is_begun_by_any(self, step: str, key: str) -> bool:
        """The same by whatever version."""
        return self._steps("begun").get(step, "").partition(_BY)[0] == key

    def has_begun(self, step: str) -> bool:
        """Whether a step was begun, for whatever photographs and settings."""
        return step in self._steps("begun")

    def begin(self, step: str, key: str) -> None:
        self._note("begun", step, f"{key}{_VERSION}")

    def finish(self, step: str, key: str) -> None:
        self._note("done", step, key)

    def forget(self, *steps: str) -> None:
        """Take steps for not begun: what they worked on is made anew."""
        known = {name: self._steps(name) for name in ("begun", "done")}
        write_json(self.path / STEPS_FILE, {
            name: {step: key for step, key in noted.items() if step not in steps} for name, noted in known.items()
        })  # fmt: skip

    @contextmanager
    def open_database(self) -> Iterator[pycolmap.Database]:
        """COLMAP's database. Raises VdgsError where the disk refuses."""
        with explain_colmap_errors(self.path):
            database = pycolmap.Database.open(self.database)
            try:
                yield database
            finally:
                database.close()

    def check_room(self, size: int) -> None:
        """Raise VdgsError where the disk has not so many bytes: COLMAP ends the process where it finds none."""
        if shutil.disk_usage(self.path).free < size:
            raise VdgsError(
                f"{self.path}: the disk is full: the next step needs {data_size(size)}. Free some space; the same "
                "command then goes on."
            )

    def remove(self) -> None:
        shutil.rmtree(self.path, ignore_errors=True)

    def _steps(self, which: str) -> dict[str, str]:
        steps = read_json_or_empty(self.path / STEPS_FILE).get(which)
        return steps if isinstance(steps, dict) else {}

    def _note(self, which: str, step: str, key: str) -> None:
        steps = {name: self._steps(name) for name in ("begun", "done")}
        steps[which][step] = key
        if which == "begun":
            steps["done"].pop(step, None)
        write_json(self.path / STEPS_FILE, steps)


def cache_key(*parts: Any) -> str:
    """A short key of anything that JSON can hold."""
    return blake2b(json.dumps(parts, sort_keys=True, default=str).encode(), digest_size=12).hexdigest()


def call_cancellable(function: Callable[..., Result], *arguments: Any, **named: Any) -> Result:
    """Call a long function of COLMAP beside this thread, so that Ctrl-C is heard and ends it where it is whole.

    The first argument, if any, is the database. Raises VdgsError for what COLMAP cannot do, and what asked to stop.
    """
    token, ended, over = pycolmap.CancellationToken(), dict[str, Any](), threading.Event()

    def work() -> None:
        try:
            ended["result"] = function(*arguments, **named, cancellation_token=token)
        except BaseException as error:
            ended["error"] = error
        finally:
            over.set()

    def tell_failed() -> None:  # as COLMAP's threads do where their database finds no room
        ended["error"], ended["hangs"] = RuntimeError("a thread of it failed"), True
        over.set()

    thread = threading.Thread(target=work, name="colmap", daemon=True)
    try:
        with catch_in_threads(tell_failed):
            thread.start()
            # Not by joining the thread: a join that is interrupted takes the thread for ended.
            while not over.wait(_POLL_SECONDS):
                pass
        check_stop_requested()
    except BaseException:
        token.cancel()
        while not over.wait(_POLL_SECONDS) and thread.ident is not None:  # None: stopped before it began
            pass
        raise
    if "hangs" not in ended:
        thread.join()
    if "error" in ended:
        with explain_colmap_errors(Path(arguments[0]).parent if arguments else None):
            raise ended["error"]
    return ended["result"]


@contextmanager
def explain_colmap_errors(folder: Path | None) -> Iterator[None]:
    """A context in which COLMAP works, in a folder or in memory: errors of COLMAP become VdgsErrors, with the remedy
    where the disk is full (SQLite says so, or that SQLite cannot open the database)."""
    try:
        yield
    except (RuntimeError, ValueError, IndexError) as error:
        said, where = " ".join(str(error).split()), "" if folder is None else f"{folder}: "
        if folder is not None and (is_disk_full(folder) or _FULL_DISK.search(said)):
            raise VdgsError(
                f"{where}the disk is full ({said}). Free some space; the same command then goes on."
            ) from error
        raise CaptureError(f"{where}COLMAP could not go on ({said}). What was done is kept.") from error


@contextmanager
def report_progress(
    workspace: Workspace, console: Console, step: SfmStep, total: int, note: str = ""
) -> Iterator[Callable[[int], None]]:
    """A bar with the time left where the console is a terminal, else a line for every tenth; yields what tells how many
    are done. `vdgs status` reads the same from the work folder."""
    later = SFM_STEPS[SFM_STEPS.index(step) + 1 :]
    expected = read_json_or_empty(workspace.expected_file)
    record = StepRecord(
        stage=SFM_STAGE,
        step=step,
        unit=_UNITS.get(step, "photographs"),
        total=total,
        later_seconds=sum(float(expected.get(name, 0)) for name in later),
    )
    title = f"{step}, {note}{record.unit}"
    progress = StepProgress(workspace.progress_file, record)
    if not console.is_terminal:
        console.print(f"{title}: {total}", highlight=False)
        yield _ProgressLines(title, progress, console)
        return
    with make_progress_bar(console, counts=True, transient=False) as bar:
        task = bar.add_task(title, total=total)

        def tell(done: int) -> None:
            bar.update(task, completed=done)
            progress(done)

        yield tell


class _ProgressLines:
    """How far work is, for logs: a line for every tenth, with the time left, and none in the first half minute."""

    def __init__(self, title: str, progress: StepProgress, console: Console) -> None:
        self.title, self.progress, self.console = title, progress, console
        self.began, self.told = time.monotonic(), 0

    def __call__(self, done: int) -> None:
        record = self.progress(done)
        tenth, left = 10 * done // max(1, record.total), record.seconds_left
        if time.monotonic() - self.began < _MIN_LOG_SECONDS or tenth <= self.told or left is None:
            return
        if done < record.total:
            self.told = tenth
            line = f"{self.title}: {done} of {record.total}, about {rough_duration(left)} left"
            self.console.print(line, highlight=False)


def silence_colmap() -> None:
    """COLMAP's own log is for its makers: errors come as exceptions, progress is shown here."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    pycolmap.set_random_seed(0)
