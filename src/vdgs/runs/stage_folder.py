"""The folder of one stage of a run: its checkpoints, log, model and status, as files (docs/architecture.md)."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vdgs.errors import RunError
from vdgs.model.model_metadata import is_cut_off
from vdgs.partition.block_records import MergedBlockRecord
from vdgs.system.atomic_files import read_json, write_json, write_text
from vdgs.system.file_locks import is_known_locked, lock_folder
from vdgs.system.records import record_from_dict, record_to_compact_dict


@dataclass(frozen=True, kw_only=True)
class StatusRecord:
    """status.json; None for what a stage does not record."""

    state: str = "new"
    """new (nothing is written yet), queued, running, stopped, done or failed."""
    reason: str | None = None
    """Why it failed or stopped, or has nothing to train."""
    iteration: int | None = None
    iterations: int | None = None
    images_drawn: float | None = None
    """How many images' worth of pixels were drawn; None where every iteration draws a whole one."""
    anchors: int | None = None
    psnr_training: float | None = None
    seconds: float | None = None
    seconds_left: int | None = None
    peak_memory_bytes: int | None = None
    model_id: str | None = None
    """The identity of the finished model (`system.tensors.file_id`)."""

    # Of a merged scene:
    blocks_trained: int | None = None
    blocks: tuple[MergedBlockRecord, ...] | None = None
    block_models: tuple[str | None, ...] | None = None
    """`model_id` of each block; None for one that is missing."""
    merge_seconds: float | None = None
    merge_peak_memory_bytes: int | None = None


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
    def initialization_file(self) -> Path:
        """What the coarse stage started from."""
        return self.path / "initialization.json"

    @property
    def model(self) -> Path:
        return self.path / "model.safetensors"

    @property
    def status_file(self) -> Path:
        return self.path / "status.json"

    def status(self) -> StatusRecord:
        """What `set_status` wrote last; state "new" if nothing did. RunError if the file is damaged."""
        if not self.status_file.exists():
            return StatusRecord()
        written = read_json(self.status_file)
        try:
            if isinstance(written, dict) and "state" not in written:
                raise ValueError("it says no state")
            return record_from_dict(StatusRecord, written)
        except ValueError as error:
            raise RunError(
                f"{self.status_file}: is damaged ({error}). Delete this file and run the same command again."
            ) from error

    def set_status(self, status: StatusRecord) -> None:
        write_json(self.status_file, record_to_compact_dict(status))

    @property
    def key_file(self) -> Path:
        return self.path / "key"

    def key(self) -> str | None:
        """The key (`stage_keys`) that this folder works for; None if it has none."""
        try:
            return self.key_file.read_text(encoding="ascii", errors="replace").strip()
        except OSError:
            return None

    def reset_unless(self, key: str) -> None:
        """Delete what is here unless it was made for this key, and write the key.

        The key is written last: a folder never holds work of other settings than those of its key.
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

    def has_output(self) -> bool:
        """Whether something was trained here."""
        return self.model.exists() or any(self.checkpoints.glob("*.json"))

    def is_done(self, key: str | None = None) -> bool:
        """Trained to the end, for the settings of `key` where one is given."""
        return self.status().state == "done" and self.model.exists() and key in (None, self.key())

    def needs_no_work(self, key: str) -> bool:
        """Trained to the end for the settings of `key`, and the file of the model was not cut off afterwards."""
        return self.is_done(key) and not is_cut_off(self.model)

    @contextmanager
    def locked(self, on_wait: Callable[[], object] | None = None) -> Iterator[None]:
        """Lock this stage for this process; RunError if another one works on it, unless that is waited for (as
        `lock_folder` has it)."""
        with lock_folder(self.path, on_wait=on_wait):
            yield

    def is_locked_elsewhere(self) -> bool:
        """Whether another process works on this stage. A folder that cannot be written is locked by none."""
        return is_known_locked(self.path)

    def truncate_log(self, iteration: int) -> None:
        """Drop log lines after `iteration` (and a half-written last one), so that a continued run repeats none."""
        if not self.log.exists():
            return
        lines = []
        for line in self.log.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if json.loads(line)["iteration"] <= iteration:
                    lines.append(line)
            except (ValueError, KeyError, TypeError):
                break
        write_text(self.log, "".join(line + "\n" for line in lines))
