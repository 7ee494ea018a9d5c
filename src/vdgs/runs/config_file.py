"""config.yaml of a run folder: its settings, and the command that gave them."""

from __future__ import annotations

import os
import shlex
import subprocess
from copy import deepcopy
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from vdgs import __version__
from vdgs.errors import RunError
from vdgs.settings.method import MethodConfig
from vdgs.settings.plain import differences, from_dict, to_dict
from vdgs.settings.ranges import option, outside
from vdgs.storage.files import write_text

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
class ConfigFile:
    """The settings of a run on disk."""

    path: Path

    def write(self, settings: dict[str, Any], command: str | None = None) -> None:
        header = {"vdgs": {"version": __version__, "commit": commit()} | ({"command": command} if command else {})}
        write_text(self.path, yaml.safe_dump(header | settings, sort_keys=False, allow_unicode=True))

    def command(self) -> str | None:
        """The command that gave the run the settings that it has; None where several did, nothing says it, or the
        folder is a copy of the one that the command works on."""
        try:
            header = yaml.safe_load(self.path.read_text(encoding="utf-8-sig"))["vdgs"]
        except (OSError, yaml.YAMLError, RecursionError, ValueError, KeyError, TypeError):
            return None
        command = header.get("command") if isinstance(header, dict) else None
        return command if isinstance(command, str) and not _makes_another(command, self.path.parent) else None

    def settings(self) -> dict[str, Any]:
        """The settings of the run, every section whole, without the header that says which version wrote them."""
        if not self.path.exists():
            raise RunError(
                f"{self.path.parent}: is not a run folder (no config.yaml). Train first: vdgs run CAPTURE --output RUN"
            )
        try:
            text = self.path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise RunError(f"{self.path}: is damaged, not valid YAML ({error})") from error
        return deepcopy(_settings(self.path, text))


@lru_cache(maxsize=4)
def _settings(path: Path, text: str) -> dict[str, Any]:
    """What the text of a file means. A command asks for its settings many times, and PyYAML takes tens of milliseconds
    for each (its quick parser, in C, is no way out: brackets that are nested deeply end the process)."""
    try:
        settings = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise RunError(f"{path}: is damaged, not valid YAML ({error})") from error
    if not isinstance(settings, dict) or not {"capture", "training"} <= settings.keys():
        raise RunError(f"{path}: is damaged or not of a vdgs run (no `capture` and `training`)")
    settings.pop("vdgs", None)
    capture = settings.pop("capture")
    if not isinstance(capture, dict) or not isinstance(capture.get("path"), str):
        raise RunError(f"{path}: is damaged: `capture` must be a group of settings with a path")
    try:
        return {"capture": capture} | to_dict(_method(settings))
    except (ValueError, TypeError) as error:
        raise RunError(
            f"{path}: {error}. Write it as it was, or start a new --output: runs of another version do not go on."
        ) from error


def _method(settings: dict[str, Any]) -> MethodConfig:
    """Raises ValueError for a setting that there is not, of another kind or out of its range."""
    method = from_dict(MethodConfig, settings, "")
    for section in SECTIONS[1:]:
        for each in outside(getattr(method, section), (section,)):
            raise ValueError(f"{'.'.join(each.path)} is {each.value}; it must be {each.range}")
    return method


def _makes_another(command: str, folder: Path) -> bool:
    """Whether a command names the whole path of another folder as its output: this one is a copy."""
    try:
        words = shlex.split(command)
    except ValueError:
        return True
    outputs = [after for word, after in pairwise(words) if word == "--output"]
    outputs += [word.removeprefix("--output=") for word in words if word.startswith("--output=")]
    return any(os.path.isabs(each) and os.path.realpath(each) != os.path.realpath(folder) for each in outputs)


def commit() -> str | None:
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
