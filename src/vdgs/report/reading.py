"""Files of a run as the report reads them: what is missing or damaged is None, never an error."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml


def read_mapping(path: Path) -> dict[str, Any] | None:
    """A JSON object; None if it is missing or damaged."""
    value = _read(path)
    return value if isinstance(value, dict) else None


def read_rows(path: Path) -> list[dict[str, Any]]:
    """A JSON list of objects; what is none is left out."""
    return rows_of(_read(path))


def rows_of(value: Any) -> list[dict[str, Any]]:
    """The objects of a list; nothing where it is none."""
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def words_of(value: Any) -> list[str]:
    """The texts of a list; nothing where it is none."""
    return [str(word) for word in value] if isinstance(value, list) else []


def read_log(path: Path) -> list[dict[str, Any]]:
    """The lines of a log.jsonl that are whole and say their iteration."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []
    rows = []
    for line in lines:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and number(row.get("iteration")) is not None:
            rows.append(row)
    return rows


def read_settings(path: Path) -> dict[str, Any]:
    """config.yaml, or nothing."""
    try:
        value = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return {}
    return value if isinstance(value, dict) else {}


def number(value: Any) -> float | None:
    """A finite number, or None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def get(values: Mapping[str, Any] | None, *path: str) -> Any:
    """A nested value, or None where the path ends before it."""
    for name in path:
        if not isinstance(values, Mapping):
            return None
        values = values.get(name)
    return values


def shown(value: Any, form: str = "{:.2f}") -> str:
    """A number in words, a dash where there is none."""
    known = number(value)
    return "–" if known is None else form.format(known)


def change(before: Any, after: Any, form: str = "{:+.2f}") -> str:
    first, second = number(before), number(after)
    return "–" if first is None or second is None else form.format(second - first)


def minutes(seconds: Any) -> str:
    """A time in words."""
    known = number(seconds)
    if known is None:
        return "–"
    if known < 60:
        return f"{known:.1f} s"
    whole = round(known)
    return (
        f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d} h"
        if whole >= 3600
        else f"{whole // 60} min {whole % 60:02d} s"
    )


def gigabytes(count: Any) -> str:
    known = number(count)
    return "–" if known is None else f"{known / 1e9:.2f} GB"


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
