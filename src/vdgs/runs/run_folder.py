"""The run folder: settings, states and results of one run, as files (docs/architecture.md)."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vdgs.captures.reconstruction import OWN_CAPTURE, RECONSTRUCTION_FILE, is_reconstruction
from vdgs.config.method import MethodConfig
from vdgs.errors import RunError, VdgsError
from vdgs.partition.block_records import PartitionRecord
from vdgs.runs.config_file import ConfigFile, changed_flags
from vdgs.runs.run_settings import SECTIONS, RunSettings
from vdgs.runs.stage_folder import StageFolder
from vdgs.runs.stage_keys import StageKeys, stage_keys
from vdgs.system.atomic_files import read_json, read_json_or_empty
from vdgs.system.file_locks import is_known_locked, lock_folder
from vdgs.system.quoting import shell_line, shell_word
from vdgs.system.records import record_from_dict
from vdgs.system.step_progress import StepProgress, StepRecord

#: The record of what moves between the photographs, and a picture of the photographs of which most moves
#: (`runs.motion_masks`), relative to the run.
MOTION_FILE, MOTION_EXAMPLES = "coarse/motion/motion.json", "coarse/motion/examples.png"

#: The page about a run (`vdgs report`) and the facts of its place, in its folder.
REPORT_FILE, PLACE_FILE = "report.html", "place.json"
#: What to do where other settings make trained work useless.
REMEDY_OF_OTHER_SETTINGS = (
    "Add --overwrite to train that again, give the old settings to continue, or begin another run: vdgs run CAPTURE "
    "--output RUN"
)
#: The folders of runs that this process drives.
_driven = set[Path]()


@dataclass(frozen=True)
class RunFolder:
    """A run on disk."""

    path: Path

    @property
    def own_capture(self) -> Path:
        """The capture that a run of photographs alone makes of them."""
        return self.path / OWN_CAPTURE

    @property
    def config_file(self) -> Path:
        return self.path / "config.yaml"

    @property
    def config(self) -> ConfigFile:
        return ConfigFile(self.config_file)

    @property
    def capture_file(self) -> Path:
        return self.path / "capture.json"

    @property
    def place_file(self) -> Path:
        return self.path / PLACE_FILE

    @property
    def cameras_file(self) -> Path:
        return self.path / "cameras.json"

    @property
    def coarse(self) -> StageFolder:
        return StageFolder(self.path / "coarse")

    def block(self, index: int) -> StageFolder:
        return StageFolder(self.path / "blocks" / f"{index:02d}")

    def block_folders(self) -> list[StageFolder]:
        """The folders of blocks that are there, in order; a folder whose name is no number is none."""
        paths = [path for path in (self.path / "blocks").glob("[0-9]*") if path.name.isdecimal()]
        return [StageFolder(path) for path in sorted(paths, key=lambda path: int(path.name))]

    @property
    def visibility(self) -> Path:
        return self.path / "visibility"

    @property
    def partition(self) -> Path:
        return self.path / "partition"

    def partition_record(self) -> PartitionRecord:
        """The content of partition.json; empty if the scene is not partitioned yet. RunError for a damaged file."""
        file = self.partition / "partition.json"
        try:
            return record_from_dict(PartitionRecord, read_json(file)) if file.exists() else PartitionRecord()
        except (VdgsError, ValueError) as error:
            raise RunError(
                f"{file}: is damaged. Cut the scene again: vdgs partition {shell_word(self.path)}"
            ) from error

    @property
    def merged(self) -> StageFolder:
        return StageFolder(self.path / "merged")

    @property
    def evaluation(self) -> Path:
        return self.path / "evaluation"

    def create_or_check(
        self, settings: RunSettings, checked: Sequence[str] = SECTIONS, command: str | None = None
    ) -> None:
        """Write the settings of a new run, or check that those of the run that is there are the same.

        `command` is the command line, saved so that people can be told how to continue. Only the sections named in
        `checked` are compared. Raises RunError with the differences, and if the folder holds something else.
        """
        if self.config_file.exists():
            changed = changed_flags(self.settings(), settings, checked)
            if changed:
                raise RunError(
                    f"{self.config_file}: this run was started with other settings:\n  "
                    + "\n  ".join(changed)
                    + "\nGive the old settings to continue it, or begin another run: vdgs run CAPTURE --output RUN"
                )
            return
        self.check_output_empty()
        self.config.write(settings, command)

    def check_output_empty(self) -> None:
        """Raise RunError where a new run would be begun among other files."""
        if self.config_file.exists():
            return
        known = {".lock", self._driver.name, *([self.own_capture.name] if is_reconstruction(self.own_capture) else [])}
        if self.path.exists() and not self.path.is_dir():
            raise RunError(f"{self.path}: is a file. Choose a folder for the run.")
        files = self.path.iterdir() if self.path.exists() else ()
        if unknown := sorted(file.name for file in files if file.name not in known and file.suffix != ".tmp"):
            raise RunError(
                f"{self.path}: holds other files ({', '.join(unknown[:3])}) and no config.yaml. "
                "Choose an empty or a new folder for the run."
            )

    def change_settings(self, settings: RunSettings, overwrite: bool, command: str | None = None) -> list[str]:
        """Give a run other settings; returns what changed, one line each. `command` as in `create_or_check`.

        Raises RunError, with the differences, if trained work depends on what changed, unless `overwrite`. Stages
        delete what was made for other settings when they next run (`StageFolder.reset_unless`).
        """
        old = self.settings()
        if old == settings:
            self.move_capture(Path(settings.capture_path))  # it may have moved with the run
            return []
        changed, after = changed_flags(old, settings), self.keys(settings)
        lost = self.find_lost(settings)
        if lost and not overwrite:
            raise RunError(
                f"{self.config_file}: other settings than this run has:\n  "
                + "\n  ".join(changed)
                + f"\nThey make {' and '.join(lost)} useless. {REMEDY_OF_OTHER_SETTINGS}"
            )
        self.config.write(settings, command)
        if self.coarse.path.exists():  # at once: nothing must be built on a model of other settings
            self.coarse.reset_unless(after.coarse)
        return changed

    def find_lost(self, settings: RunSettings) -> list[str]:
        """What was trained that other settings make useless, in words; nothing where it stays."""
        after, lost = self.keys(settings), list[str]()
        if self.coarse.has_output() and self.coarse.key() != after.coarse:
            lost.append("the coarse model")
        blocks = [folder for folder in self.block_folders() if folder.has_output() and folder.key() != after.blocks]
        if blocks:
            lost.append(f"{len(blocks)} blocks" if len(blocks) > 1 else "a block")
        return lost

    @property
    def is_trained(self) -> bool:
        """Whether training on the capture has begun."""
        return self.capture_file.exists()

    def discard_training(self) -> None:
        """Delete what was trained: the capture of the run is about to be made anew. RunError where another process
        works on the run, such as blocks whose driver died."""
        with self.locked():
            for folder in (self.coarse, *self.block_folders(), self.merged):
                if folder.path.exists():
                    folder.reset_unless("")
            self.capture_file.unlink(missing_ok=True)

    def move_capture(self, to: Path) -> None:
        """Save that the capture of the run lies elsewhere now, with the files in it that options name; the caller
        checks that it is the same one."""
        settings, command = self.config.settings(), self.config.command()
        before, now = settings.capture_path, str(to.resolve())
        if before == now:
            return
        words = shlex.split(command) if command else []
        named = [now + word[len(before) :] if f"{word}/".startswith(f"{before}/") else word for word in words]
        moved = shell_line(named) if before in words else None
        self.config.write(settings.moved(to.resolve()), moved)

    def settings(self) -> RunSettings:
        """The settings of the run (`ConfigFile.settings`). A capture that the run made in its own folder lies where
        this folder lies now, moved or copied."""
        settings = self.config.settings()
        return settings.moved(self.own_capture.resolve()) if self._holds_capture_of(settings) else settings

    def _holds_capture_of(self, settings: RunSettings) -> bool:
        """Whether `own_capture` is the capture that the settings have at a place in another folder: one of its name
        that was made here, with the reconstruction that the run was begun with."""
        written, own = Path(settings.capture_path), self.own_capture
        if written.name != own.name or written == own.resolve() or not is_reconstruction(own):
            return False
        copy, original = (folder / RECONSTRUCTION_FILE for folder in (self.path, own))
        if not (copy.is_file() and original.is_file()):
            return copy.is_file() == original.is_file()
        return copy.read_bytes() == original.read_bytes()

    def missing_capture(self) -> str:
        """That the capture of the run is not where the run looks for it, and what to do; empty where it is there."""
        path = Path(self.settings().capture_path)
        if path.exists():
            return ""
        return (
            f"{path}: the capture of {self.path} is not there. If it was moved, say where to, once: "
            f"vdgs visibility {shell_word(self.path)} --capture PATH"
        )

    def method(self) -> MethodConfig:
        """The settings of the run but for the capture."""
        return self.settings().method

    def keys(self, settings: RunSettings | None = None) -> StageKeys:
        """The key of every stage, for these settings or those that config.yaml holds, and for the coarse model and the
        record of what moves that are there."""
        return stage_keys(settings or self.settings(), self.coarse_model_id(), read_json_or_empty(self.motion_file))

    @property
    def motion_file(self) -> Path:
        """The record of what moves between the photographs (`runs.motion_masks`)."""
        return self.path / MOTION_FILE

    def coarse_model_id(self) -> str | None:
        """The identity of the coarse model; None while there is none."""
        return self.coarse.status().model_id

    @contextmanager
    def locked(self, shared: bool = False, on_wait: Callable[[], object] | None = None) -> Iterator[None]:
        """Lock the run for this process, or share it with others that do (blocks are trained side by side).

        RunError if another process holds it, unless that is waited for (as `lock_folder` has it).
        """
        with lock_folder(self.path, shared, on_wait):
            yield

    @contextmanager
    def drive_lock(self) -> Iterator[None]:
        """The lock of a process that takes the run from stage to stage or changes its settings (`is_running`): between
        two stages, and while a model is measured or drawn, it holds nothing else. RunError if another process has it.
        """
        with lock_folder(self._driver):
            _driven.add(self.path.resolve())
            try:
                yield
            finally:
                _driven.discard(self.path.resolve())

    def is_running(self) -> bool:
        return is_known_locked(self._driver)

    def is_driven_here(self) -> bool:
        """Whether it is this process that takes the run from stage to stage."""
        return self.path.resolve() in _driven

    @property
    def progress_file(self) -> Path:
        """How far the process that drives the run is."""
        return self._driver / "progress.json"

    def begin_step(self, stage: str, step: str = "", unit: str = "", total: int = 0) -> StepProgress:
        """Record what this process works on, if this process drives the run; what is returned takes how many are
        done. Another process, such as `vdgs ortho` beside `vdgs run`, records nothing."""
        file = self.progress_file if self.is_driven_here() else None
        progress = StepProgress(file, StepRecord(stage=stage, step=step, unit=unit, total=total))
        progress(0)
        return progress

    @property
    def _driver(self) -> Path:
        return self.path / ".run"
