"""Files of a run, read with caution: a report is also written of runs that are unfinished or damaged."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vdgs.report.embedded_images import EmbeddedImage, ImageReadError, load_embedded_image
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStatus, StageStatus
from vdgs.system.units import ABSENT, count

#: Characters of one text, and entries of one list of texts, that a report shows.
MAX_TEXT_CHARS, MAX_TEXTS = 600, 40
#: Numbers beyond are damage.
MAX_ABS_VALUE = 1e30
#: States that need more words than their name.
STATE_LABELS = {"stale": "out of date", "unknown": "not known"}
#: How decibels and similarities (SSIM, LPIPS) are written.
DB, SIMILARITY = "{:.2f}", "{:.4f}"


def format_value(value: float | None, form: str) -> str:
    """A number for people; a dash where there is none."""
    return ABSENT if value is None else form.format(value)


def format_percent(value: float | None) -> str:
    return ABSENT if value is None else f"{100 * value:.1f} %"


def format_difference(after: float | None, before: float | None, form: str = DB) -> str:
    """The difference with its sign: a minus as in print, and never one before a zero."""
    if after is None or before is None:
        return ABSENT
    signed = form.replace("{:", "{:+").format(after - before)
    return signed.replace("-", "−" if float(signed.replace(",", "")) else "+")


@dataclass(frozen=True)
class JsonRecord:
    """A JSON object in which anything may be missing or of another kind than expected."""

    values: Mapping[str, Any]

    def __bool__(self) -> bool:
        return bool(self.values)

    def number(self, key: str) -> float | None:
        """A number that a run may hold, or None: not NaN, infinity or nonsense that no axis can show."""
        value = self.values.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        return float(value) if abs(value) <= MAX_ABS_VALUE else None

    def format(self, key: str, form: str = DB) -> str:
        return format_value(self.number(key), form)

    def count(self, key: str) -> str:
        return count(self.number(key))

    def text(self, key: str) -> str | None:
        value = self.values.get(key)
        return _shortened(value) if isinstance(value, str) else None

    def texts(self, key: str) -> list[str]:
        values = self.values.get(key)
        if not isinstance(values, list):
            return []
        texts = [_shortened(value) for value in values if isinstance(value, str)]
        more = len(texts) - MAX_TEXTS
        return texts[:MAX_TEXTS] + ([f"… and {more} more"] if more > 0 else [])

    def child(self, key: str) -> JsonRecord:
        return _record(self.values.get(key))

    def rows(self, key: str) -> list[JsonRecord]:
        return _rows(self.values.get(key))


@dataclass(frozen=True)
class ReportedRun:
    """The run that a report shows, and how far its stages are."""

    run: RunFolder
    status: RunStatus

    def files(self) -> RunFiles:
        """Its files, for one section: those that do not fit the run are left out."""
        stale = {stage.folder: _stale_note(stage) for stage in self.status.stages if stage.state == "stale"}
        return RunFiles(self.run.path, stale)

    @property
    def is_one_block(self) -> bool:
        """Whether the scene is cut into a single block: then nothing is divided among blocks, and nothing merged."""
        return len(RunFiles(self.run.path).record("partition/partition.json").rows("blocks")) == 1

    def stage_state(self, name: str) -> str:
        """How far a stage is, in words."""
        stage = self.status.of(name)
        state, why = STATE_LABELS.get(stage.state, stage.state), stage.reason
        if stage.state == "unknown" and stage.status is not None:  # the caution at the top says the rest
            state, why = stage.status.state, stage.status.reason or ""
        return state + (f": {why}" if why else "")

    def warnings(self) -> list[str]:
        """What to say of all that is shown though nobody knows whether it fits."""
        unknown = [stage for stage in self.status.stages if stage.state == "unknown"]
        if not unknown:
            return []
        names = ", ".join(stage.name for stage in unknown)
        reason = unknown[0].reason
        return [f"It cannot be told whether these were made with the settings of the run: {names} ({reason})."]


def _stale_note(stage: StageStatus) -> str:
    """Why a stage is left out, in a sentence."""
    return f"{stage.folder}: {stage.reason}; it is left out. `vdgs status` says which command makes it anew."


class RunFiles:
    """The files of a run folder, for one section: what cannot be read is left out, and `notes` says so.

    So are files below the folders in `stale`, each with the sentence that says why.
    """

    def __init__(self, root: Path, stale: Mapping[str, str] | None = None):
        self._root, self._stale = root, stale or {}
        self.notes: list[str] = []

    def has(self, name: str) -> bool:
        return not self._is_stale(name) and self.exists(name)

    def exists(self, *names: str) -> bool:
        """Whether one of these files is there, in date or not."""
        # Unlike Path.exists, os.path.exists raises no error for names that no file can have.
        return any(os.path.exists(self._root / name) for name in names)

    def _is_stale(self, name: str) -> bool:
        """Whether a file that is there does not fit the run; the notes then say why, once."""
        why = next((why for folder, why in self._stale.items() if name.startswith(f"{folder}/")), None)
        if why is None or name.endswith("/status.json") or not self.exists(name):
            return False
        if why not in self.notes:
            self.notes.append(why)
        return True

    def record(self, name: str) -> JsonRecord:
        """The JSON object of a file; empty if there is none."""
        return _record(self._json(name, dict))

    def rows(self, name: str) -> list[JsonRecord]:
        """The JSON objects of a file that lists them."""
        return _rows(self._json(name, list))

    def lines(self, name: str) -> list[JsonRecord]:
        """The JSON objects of a file with one on each line."""
        records = [_record(_parse_or_none(line)) for line in (self.text(name) or "").splitlines()]
        if bad := sum(not record for record in records):
            lines = "1 line could not be read and is" if bad == 1 else f"{bad} lines could not be read and are"
            self.notes.append(f"{name}: {lines} left out.")
        return [record for record in records if record]

    def text(self, name: str) -> str | None:
        """The text of a file; None if there is none."""
        try:
            return (self._root / name).read_text(encoding="utf-8", errors="replace") if self.has(name) else None
        except OSError as error:
            self.notes.append(f"{name} cannot be read ({error.strerror or error}).")
            return None

    def image(self, name: str) -> EmbeddedImage | None:
        """A PNG of the run, ready to embed; None if there is none."""
        try:
            return load_embedded_image(self._root / name) if self.has(name) else None
        except ImageReadError as error:
            self.notes.append(f"{name} is damaged or not a PNG ({error}); it is left out.")
            return None

    def _json(self, name: str, kind: type) -> Any:
        text = self.text(name)
        if text is None:
            return None
        try:
            value = json.loads(text)
        except (ValueError, RecursionError) as error:
            self.notes.append(f"{name} is damaged, not valid JSON ({error}); what it says is left out.")
            return None
        if not isinstance(value, kind):
            expected = "an object" if kind is dict else "a list"
            self.notes.append(f"{name} is damaged, it does not hold {expected}; what it says is left out.")
            return None
        return value


def _parse_or_none(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_TEXT_CHARS else text[:MAX_TEXT_CHARS] + "…"


def _record(value: Any) -> JsonRecord:
    return JsonRecord(value if isinstance(value, dict) else {})


def _rows(value: Any) -> list[JsonRecord]:
    return [JsonRecord(each) for each in value if isinstance(each, dict)] if isinstance(value, list) else []
