"""The run folder: settings, states and results of one run, as files (docs/architecture.md)."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from vdgs import __version__
from vdgs.captures.reconstruction import is_reconstruction
from vdgs.errors import RunError, VdgsError
from vdgs.partition.records import PartitionRecord
from vdgs.runs.keys import StageKeys, stage_keys
from vdgs.runs.locks import hold, is_locked
from vdgs.runs.status import Status
from vdgs.settings.method import MethodConfig
from vdgs.settings.plain import differences, from_dict, to_dict
from vdgs.settings.ranges import numbers, option
from vdgs.storage.files import read_json, write_json, write_text
from vdgs.storage.records import known, record_of

#: The parts of config.yaml.
SECTIONS = ("capture", "training", "partition", "assignment", "block", "merge")
#: Those whose options have no prefix on the command line.
PLAIN_SECTIONS = ("capture", "training", "partition")


def option_of(setting: str) -> str:
    """`--lambda-vis` for partition.lambda_vis: how `vdgs run` calls a setting of config.yaml."""
    section, _, name = setting.partition(".")
    return option((name,) if section in PLAIN_SECTIONS else (section, name))


def changed_options(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Lines that say which options differ between the settings of two runs; where the capture lies is none."""
    paths = [line.partition(": ") for line in differences(old, new) if not line.startswith("capture.path: ")]
    return [f"{option_of(path)}: {values}" for path, _, values in paths]


@dataclass(frozen=True)
class StageFolder:
    """Where one stage (coarse, a block) keeps its checkpoints, log and model."""

    path: Path

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def log(self) -> Path:
        return self.path / "log.jsonl"

    @property
    def model(self) -> Path:
        return self.path / "model.safetensors"

    @property
    def status_file(self) -> Path:
        return self.path / "status.json"

    def status(self) -> Status:
        """What `set_status` wrote last; state "new" if nothing did. RunError if the file is damaged."""
        if not self.status_file.exists():
            return Status()
        written = read_json(self.status_file)
        try:
            if isinstance(written, dict) and "state" not in written:
                raise ValueError("it says no state")
            return record_of(Status, written)
        except ValueError as error:
            raise RunError(
                f"{self.status_file}: is damaged ({error}). Delete this file and run the same command again."
            ) from error

    def set_status(self, status: Status) -> None:
        write_json(self.status_file, known(status))

    @property
    def key_file(self) -> Path:
        return self.path / "key"

    def key(self) -> str | None:
        """For which settings (`stages/keys.py`) this folder works; None if it says nothing of it."""
        try:
            return self.key_file.read_text(encoding="ascii", errors="replace").strip()
        except OSError:
            return None

    def discard_unless(self, key: str) -> None:
        """Delete what is here unless it was made for these settings, and let the folder work for them from now on.

        What was made for other or unknown settings goes first and the key is written last: a folder never holds what
        its key does not say.
        """
        if self.key() == key:
            return
        if self.path.exists():
            for stale in self.path.iterdir():
                if stale.is_dir():
                    shutil.rmtree(stale)
                elif stale not in (self.path / ".lock", self.key_file):
                    stale.unlink()
        write_text(self.key_file, key + "\n")

    def holds_work(self) -> bool:
        """Something was trained here."""
        return self.model.exists() or any(self.checkpoints.glob("*.json"))

    def is_done(self, key: str | None = None) -> bool:
        """Trained to the end, for the settings of `key` where one is given."""
        return self.status().state == "done" and self.model.exists() and key in (None, self.key())

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold this stage for this process; RunError if another one works on it."""
        with hold(self.path):
            yield

    def is_held(self) -> bool:
        """Another process works on this stage. A folder that cannot be written is held by none."""
        try:
            with self.locked():
                return False
        except RunError as error:
            return isinstance(error.__cause__, BlockingIOError)

    def truncate_log(self, iteration: int) -> None:
        """Drop log lines after `iteration` (and a half-written last one), so that a continued run repeats none."""
        if not self.log.exists():
            return
        kept = []
        for line in self.log.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if json.loads(line)["iteration"] <= iteration:
                    kept.append(line)
            except (ValueError, KeyError, TypeError):
                break
        write_text(self.log, "".join(line + "\n" for line in kept))


@dataclass(frozen=True)
class RunFolder:
    """A run on disk."""

    path: Path

    @property
    def own_capture(self) -> Path:
        """The capture that a run of photographs alone makes of them."""
        return self.path / "capture"

    @property
    def config_file(self) -> Path:
        return self.path / "config.yaml"

    @property
    def capture_file(self) -> Path:
        return self.path / "capture.json"

    @property
    def cameras_file(self) -> Path:
        return self.path / "cameras.json"

    @property
    def coarse(self) -> StageFolder:
        return StageFolder(self.path / "coarse")

    def block(self, index: int) -> StageFolder:
        return StageFolder(self.path / "blocks" / f"{index:02d}")

    def block_folders(self) -> list[StageFolder]:
        """Those that are there, in order; a folder whose name is no number is not ours."""
        paths = [path for path in (self.path / "blocks").glob("[0-9]*") if path.name.isdecimal()]
        return [StageFolder(path) for path in sorted(paths, key=lambda path: int(path.name))]

    @property
    def visibility(self) -> Path:
        return self.path / "visibility"

    @property
    def partition(self) -> Path:
        return self.path / "partition"

    def partition_record(self) -> PartitionRecord:
        """What partition.json says; nothing if the scene is not cut yet. RunError if the file is damaged."""
        file = self.partition / "partition.json"
        try:
            return record_of(PartitionRecord, read_json(file)) if file.exists() else PartitionRecord()
        except (VdgsError, ValueError) as error:
            raise RunError(f"{file}: is damaged. Cut the scene again: vdgs partition {self.path}") from error

    @property
    def merged(self) -> StageFolder:
        return StageFolder(self.path / "merged")

    @property
    def gaussians(self) -> StageFolder:
        """Where 3DGS keeps its model, in runs of the bench that have it in place of all other stages."""
        return StageFolder(self.path / "gaussians")

    @property
    def evaluation(self) -> Path:
        return self.path / "evaluation"

    def begin(self, settings: dict[str, Any], checked: Sequence[str] = SECTIONS, command: str | None = None) -> None:
        """Write the settings of a new run, or check that those of the run that is there are the same.

        `command` is the one that begins it, kept so that people can be told how to continue.

        Only the sections named in `checked` are compared. Raises RunError with the differences if they are not the
        same, and if the folder holds something else.
        """
        if self.config_file.exists():
            old = self.settings()
            changed = changed_options({s: old[s] for s in checked}, {s: settings[s] for s in checked})
            if changed:
                raise RunError(
                    f"{self.config_file}: this run was started with other settings:\n  "
                    + "\n  ".join(changed)
                    + "\nGive the old settings to continue it, or another --output to start a new run."
                )
            return
        self.refuse_strangers()
        self._write(settings, command)

    def refuse_strangers(self) -> None:
        """Raise RunError where a new run would be begun among other files."""
        if self.config_file.exists():
            return
        known = {".lock", *([self.own_capture.name] if is_reconstruction(self.own_capture) else [])}
        if self.path.exists() and not self.path.is_dir():
            raise RunError(f"{self.path}: is a file. Choose a folder for --output.")
        strangers = (
            [p.name for p in self.path.iterdir() if p.name not in known and p.suffix != ".tmp"]
            if self.path.exists()
            else []
        )
        if strangers:
            raise RunError(
                f"{self.path}: holds other files ({', '.join(sorted(strangers)[:3])}) and no config.yaml. "
                "Choose an empty or a new folder for --output."
            )

    def change_settings(self, settings: dict[str, Any], redo: bool, command: str | None = None) -> list[str]:
        """Give a run other settings; returns what changed, one line each. `command` as in `begin`.

        Raises RunError, with the differences, if trained work depends on what changed, unless `redo` allows to
        lose it. Stages delete what was made for other settings when they next run (`StageFolder.discard_unless`).
        """
        old = self.settings()
        if old == settings:
            return []
        changed = changed_options(old, settings)
        after = stage_keys(settings, self.coarse_identity())
        lost = []
        if self.coarse.holds_work() and self.coarse.key() != after.coarse:
            lost.append("the coarse model")
        blocks = [folder for folder in self.block_folders() if folder.holds_work() and folder.key() != after.blocks]
        if blocks:
            lost.append(f"{len(blocks)} blocks" if len(blocks) > 1 else "a block")
        if lost and not redo:
            raise RunError(
                f"{self.config_file}: other settings than this run has:\n  " + "\n  ".join(changed)
                + f"\nThey make {' and '.join(lost)} useless. Add --redo to train that again, give the old settings to "
                "continue, or take another --output."
            )  # fmt: skip
        self._write(settings, command)
        if self.coarse.path.exists():  # at once: nothing must be built on a model of other settings
            self.coarse.discard_unless(after.coarse)
        return changed

    def move_capture(self, to: Path) -> None:
        """Remember that the capture of the run lies elsewhere now. That it is the same one is for the caller to see."""
        settings, command = self.settings(), self.command()
        before, now = settings["capture"]["path"], str(to.resolve())
        if before == now:
            return
        words = shlex.split(command) if command else []
        moved = shlex.join([now if word == before else word for word in words]) if before in words else None
        settings["capture"]["path"] = now
        self._write(settings, moved)

    def _write(self, settings: dict[str, Any], command: str | None = None) -> None:
        header = {"vdgs": {"version": __version__, "commit": _commit()} | ({"command": command} if command else {})}
        write_text(self.config_file, yaml.safe_dump(header | settings, sort_keys=False, allow_unicode=True))

    def command(self) -> str | None:
        """The command that gave the run the settings that it has; None where several did, nothing says it, or the
        folder is a copy of the one that the command works on."""
        try:
            header = yaml.safe_load(self.config_file.read_text(encoding="utf-8-sig"))["vdgs"]
        except (OSError, yaml.YAMLError, RecursionError, ValueError, KeyError, TypeError):
            return None
        command = header.get("command") if isinstance(header, dict) else None
        return command if isinstance(command, str) and not _makes_another(command, self.path) else None

    def settings(self) -> dict[str, Any]:
        """The settings of the run, every section whole, without the header that says which version wrote them."""
        if not self.config_file.exists():
            raise RunError(
                f"{self.path}: is not a run folder (no config.yaml). Train first: vdgs run CAPTURE --output RUN"
            )
        try:
            settings = yaml.safe_load(self.config_file.read_text(encoding="utf-8-sig"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise RunError(f"{self.config_file}: is damaged, not valid YAML ({error})") from error
        if not isinstance(settings, dict) or not {"capture", "training"} <= settings.keys():
            raise RunError(f"{self.config_file}: is damaged or not of a vdgs run (no `capture` and `training`)")
        settings.pop("vdgs", None)
        capture = settings.pop("capture")
        if not isinstance(capture, dict) or not isinstance(capture.get("path"), str):
            raise RunError(f"{self.config_file}: is damaged: `capture` must be a group of settings with a path")
        try:
            return {"capture": capture} | to_dict(self._read(settings))
        except (ValueError, TypeError) as error:
            raise RunError(f"{self.config_file}: {error}. Write it as it was, or start a new --output.") from error

    @staticmethod
    def _read(settings: dict[str, Any]) -> MethodConfig:
        """Raises ValueError for a setting that there is not, of another kind or out of its range."""
        method = from_dict(MethodConfig, settings, "")
        for section in SECTIONS[1:]:
            for each in numbers(getattr(method, section), (section,)):
                if each.value is not None and each.range is not None and not each.range.holds(each.value):
                    raise ValueError(f"{'.'.join(each.path)} is {each.value}; it must be {each.range}")
        return method

    def method(self) -> MethodConfig:
        """The settings of the run but for the capture."""
        settings = self.settings()
        settings.pop("capture")
        return from_dict(MethodConfig, settings)

    def keys(self) -> StageKeys:
        """The key of every stage, for the settings that config.yaml holds and the coarse model that is there."""
        return stage_keys(self.settings(), self.coarse_identity())

    def coarse_identity(self) -> str | None:
        """What tells the coarse model from any other; None while there is none."""
        return self.coarse.status().model

    @contextmanager
    def locked(self, shared: bool = False) -> Iterator[None]:
        """Hold the run for this process, or share it with others that do (blocks are trained side by side).

        RunError if another process stands in the way.
        """
        with hold(self.path, shared):
            yield

    @contextmanager
    def driven(self) -> Iterator[None]:
        """Take this run from stage to stage, so that others can see it between two stages too (`is_driven`).

        RunError if another process does.
        """
        with hold(self._driver):
            yield

    def is_driven(self) -> bool:
        return is_locked(self._driver)

    @property
    def _driver(self) -> Path:
        return self.path / ".run"


def _makes_another(command: str, folder: Path) -> bool:
    """Whether a command names the whole path of another folder as its output: this one is a copy."""
    try:
        words = shlex.split(command)
    except ValueError:
        return True
    outputs = [after for word, after in pairwise(words) if word == "--output"]
    outputs += [word.removeprefix("--output=") for word in words if word.startswith("--output=")]
    return any(os.path.isabs(each) and os.path.realpath(each) != os.path.realpath(folder) for each in outputs)


def _commit() -> str | None:
    """The commit of the checkout that this package runs from; None outside a checkout of vdgs."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists() or not (root / "native").exists():
        return None
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # no git on this machine
        return None
    return found.stdout.strip() or None
