"""How far a step of a stage is, in a small file that `vdgs status` reads while another process works."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import read_json_or_empty, write_json
from vdgs.system.records import record_from_dict, record_to_compact_dict
from vdgs.system.scratch import remove_leftovers
from vdgs.system.units import rough_duration

#: Seconds between two writes of the file.
WRITE_SECONDS = 2.0


@dataclass(frozen=True, kw_only=True)
class StepRecord:
    """How far a step is."""

    stage: str
    """The stage as `vdgs status` names it."""
    step: str = ""
    unit: str = ""
    """What is counted."""
    done: int = 0
    total: int = 0
    """0 where nothing is counted."""
    seconds_left: float | None = None
    """Of the step, by its pace."""
    later_seconds: float | None = None
    """Of the steps after it, by estimate."""

    def text(self, running: bool = True) -> str:
        """features: 12 of 18 photographs, about 40 s left, 3 min with the steps after it."""
        counted = f"{self.done:,} of {self.total:,} {self.unit}".rstrip() if self.total else ""
        parts = [": ".join(part for part in (self.step, counted) if part)]
        if running and self.seconds_left is not None:
            parts.append(f"about {rough_duration(self.seconds_left)} left")
            if self.later_seconds:
                parts.append(f"{rough_duration(self.seconds_left + self.later_seconds)} with the steps after it")
        return ", ".join(part for part in parts if part)


def read_step(file: Path) -> StepRecord | None:
    """What a `StepProgress` wrote last; None where there is nothing, or something else. Never raises."""
    try:
        return record_from_dict(StepRecord, read_json_or_empty(file))
    except ValueError:
        return None


class StepProgress:
    """Counts what is done of a step and writes it to a file every few seconds; None writes nothing."""

    def __init__(self, file: Path | None, record: StepRecord) -> None:
        self._file, self._record, self._written = file, record, -WRITE_SECONDS
        self._first: tuple[float, int] | None = None
        if file is not None:
            remove_leftovers(file)

    def __call__(self, done: int) -> StepRecord:
        """Take how many are done; what the first call tells was done before and says nothing of the pace."""
        now = time.monotonic()
        began, first = self._first = self._first or (now, done)
        left = None if done <= first else (now - began) / (done - first) * (self._record.total - done)
        self._record = replace(self._record, done=done, seconds_left=left)
        if self._file is not None and (now - self._written >= WRITE_SECONDS or done >= self._record.total):
            try:
                write_json(self._file, record_to_compact_dict(self._record))
            except VdgsError:  # a run that may only be read: its maps, elsewhere, can be made
                self._file = None
            self._written = now
        return self._record
