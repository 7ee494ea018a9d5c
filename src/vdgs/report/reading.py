"""Files of a run, read with caution: a report is also written of runs that are unfinished or damaged."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vdgs.report.pictures import Picture, PictureError, load_picture

#: Characters of one text, and entries of one list of texts, that a report shows.
LONGEST_TEXT, MOST_TEXTS = 600, 40
#: Numbers beyond are damage.
LARGEST = 1e30


@dataclass(frozen=True)
class Record:
    """A JSON object in which anything may be missing or of another kind than expected."""

    values: Mapping[str, Any]

    def __bool__(self) -> bool:
        return bool(self.values)

    def number(self, key: str) -> float | None:
        """A number that a run may hold, or None: not NaN, infinity or nonsense that no axis can show."""
        value = self.values.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return None
        return float(value) if abs(value) <= LARGEST else None

    def text(self, key: str) -> str | None:
        value = self.values.get(key)
        return _shortened(value) if isinstance(value, str) else None

    def texts(self, key: str) -> list[str]:
        values = self.values.get(key)
        if not isinstance(values, list):
            return []
        found = [_shortened(value) for value in values if isinstance(value, str)]
        more = len(found) - MOST_TEXTS
        return found[:MOST_TEXTS] + ([f"… and {more} more"] if more > 0 else [])

    def inner(self, key: str) -> Record:
        return _record(self.values.get(key))

    def rows(self, key: str) -> list[Record]:
        return _rows(self.values.get(key))


class Source:
    """The files of a run folder, for one section: what cannot be read is left out, and `notes` says so."""

    def __init__(self, root: Path):
        self._root = root
        self.notes: list[str] = []

    def has(self, name: str) -> bool:
        return os.path.exists(self._root / name)  # unlike Path.exists, no error for names that no file can have

    def record(self, name: str) -> Record:
        """The JSON object of a file; empty if there is none."""
        return _record(self._json(name, dict))

    def rows(self, name: str) -> list[Record]:
        """The JSON objects of a file that lists them."""
        return _rows(self._json(name, list))

    def lines(self, name: str) -> list[Record]:
        """The JSON objects of a file with one on each line."""
        text = self.text(name)
        found, bad = [], 0
        for line in (text or "").splitlines():
            try:
                record = _record(json.loads(line))
            except (ValueError, RecursionError):
                record = Record({})
            if record:
                found.append(record)
            else:
                bad += 1
        if bad:
            self.notes.append(f"{name}: {bad} line{'s' if bad > 1 else ''} could not be read and {_are(bad)} left out.")
        return found

    def text(self, name: str) -> str | None:
        """The text of a file; None if there is none."""
        path = self._root / name
        try:
            return path.read_text(encoding="utf-8", errors="replace") if self.has(name) else None
        except OSError as error:
            self.notes.append(f"{name} cannot be read ({error.strerror or error}).")
            return None

    def picture(self, name: str) -> Picture | None:
        """A PNG of the run, ready to embed; None if there is none."""
        path = self._root / name
        if not self.has(name):
            return None
        try:
            return load_picture(path)
        except PictureError as error:
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


def _are(count: int) -> str:
    return "is" if count == 1 else "are"


def _shortened(text: str) -> str:
    return text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT] + "…"


def _record(value: Any) -> Record:
    return Record(value if isinstance(value, dict) else {})


def _rows(value: Any) -> list[Record]:
    return [Record(each) for each in value if isinstance(each, dict)] if isinstance(value, list) else []
