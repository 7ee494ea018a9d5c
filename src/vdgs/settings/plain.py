"""Settings as plain dictionaries and back, for YAML and JSON, and what differs between two of them."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain dictionaries and lists, ready for YAML or JSON."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        if isinstance(value, (str, int, float, bool)) or value is None:
            return value
        return str(value)

    return plain(dataclasses.asdict(config))


def differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[str]:
    """Lines that say which settings differ, e.g. `growth.threshold: 0.0002 -> 0.0004`."""
    lines = []
    for key in sorted(old.keys() | new.keys()):
        before, after = old.get(key), new.get(key)
        if isinstance(before, dict) and isinstance(after, dict):
            lines += differences(before, after, f"{prefix}{key}.")
        elif before != after:
            lines.append(f"{prefix}{key}: {before} -> {after}")
    return lines


def from_dict(kind: type, values: Mapping[str, Any], where: str = "settings") -> Any:
    """The inverse of `to_dict` for a config class: what is not named keeps its default.

    Raises ValueError, naming the setting, for one that the class does not have or of another shape.
    """
    hints = typing.get_type_hints(kind)
    unknown = sorted(values.keys() - hints.keys())
    if unknown:
        raise ValueError(f"{where} has no {unknown[0]!r}")
    taken = {}
    for name, value in values.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            if not isinstance(value, Mapping):
                raise ValueError(f"{where}.{name} is {value!r}, not a group of settings")
            value = from_dict(typing.cast(type, hint), value, f"{where}.{name}")
        taken[name] = _frozen(value)
    return kind(**taken)


def _frozen(value: Any) -> Any:
    return tuple(_frozen(item) for item in value) if isinstance(value, list) else value
