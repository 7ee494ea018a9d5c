"""config.yaml of a run folder: its settings, and the command that gave them."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from vdgs import __version__
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.options import off_flag, option_words
from vdgs.config.presets import PRESETS
from vdgs.config.ranges import to_flag
from vdgs.config.serialization import diff_settings
from vdgs.errors import RunError
from vdgs.runs.run_settings import SECTIONS, RunSettings
from vdgs.system.atomic_files import write_text
from vdgs.system.quoting import shell_line

#: Sections whose options have no prefix on the command line.
UNPREFIXED_SECTIONS = ("capture", "training", "partition")


def setting_flag(setting: str) -> str:
    """The option of `vdgs run` for a setting of config.yaml: `--lambda-vis` for partition.lambda_vis."""
    section, _, name = setting.partition(".")
    return to_flag((name,) if section in UNPREFIXED_SECTIONS else (section, name))


def changed_flags(old: RunSettings, new: RunSettings, sections: Sequence[str] = SECTIONS) -> list[str]:
    """The options that differ between the settings of two runs, a line each; the path of the capture is none, nor are
    those of files in it."""
    old = old.moved(Path(new.capture_path))
    before, after = ({name: each.to_dict()[name] for name in sections} for each in (old, new))
    lines = [line.partition(": ") for line in diff_settings(before, after) if not line.startswith("capture.path: ")]
    return [f"{setting_flag(path)}: {values}" for path, _, values in lines]


def run_command(settings: RunSettings, output: Path) -> str:
    """A command that asks for these settings: those of the nearest preset, and the options that differ."""
    candidates: list[list[str]] = []
    for preset, method in PRESETS.items():
        before = RunSettings.create(settings.capture_path, CaptureOptions(), method).to_dict()
        options = [word for name, value in _differences(before, settings.to_dict()) for word in _words(name, value)]
        candidates.append(["vdgs", "run", settings.capture_path, "--output", str(output.resolve())])
        candidates[-1] += ["--preset", preset, *options]
    shortest: list[str] = min(candidates, key=len)
    return shell_line(shortest)


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Settings that differ, by their paths, with their new values."""
    for name, value in new.items():
        if isinstance(value, Mapping):
            yield from _differences(old[name], value, f"{prefix}{name}.")
        elif value != old[name]:
            yield prefix + name, value


def _words(setting: str, value: Any) -> list[str]:
    """An option and its values as a command line has them."""
    flag = setting_flag(setting)
    if isinstance(value, bool):
        return [flag if value else off_flag(flag)]
    words = list[str]()
    for item in value if isinstance(value, list) else [value]:
        words += map(str, item if isinstance(item, list) else [item])
    return option_words(flag, words)


@dataclass(frozen=True)
class ConfigFile:
    """The settings of a run on disk."""

    path: Path

    def write(self, settings: RunSettings, command: str | None = None) -> None:
        header = {"vdgs": {"version": __version__, "commit": git_commit()} | ({"command": command} if command else {})}
        write_text(self.path, yaml.safe_dump(header | settings.to_dict(), sort_keys=False, allow_unicode=True))

    def command(self) -> str | None:
        """The command that gave the run its settings; None where several did, none is recorded, or the folder is a copy
        of the one that the command works on."""
        try:
            header = yaml.safe_load(self.path.read_text(encoding="utf-8-sig"))["vdgs"]
        except (OSError, yaml.YAMLError, RecursionError, ValueError, KeyError, TypeError):
            return None
        command = header.get("command") if isinstance(header, dict) else None
        return command if isinstance(command, str) and not _is_of_another_run(command, self.path.parent) else None

    def settings(self) -> RunSettings:
        """The settings of the run."""
        if not self.path.exists():
            raise RunError(
                f"{self.path.parent}: is not a run folder (no config.yaml). Train first: vdgs run CAPTURE --output RUN"
            )
        try:
            return _parse_settings(self.path, self.path.read_text(encoding="utf-8-sig"))
        except UnicodeDecodeError as error:
            raise _not_yaml(self.path, error) from error


def _not_yaml(path: Path, error: Exception) -> RunError:
    return RunError(
        f"{path}: is damaged, not valid YAML ({yaml_fault(error)})\n"
        "Correct what is wrong there, put a whole copy there, or begin another run: vdgs run CAPTURE --output RUN"
    )


@lru_cache(maxsize=4)
def _parse_settings(path: Path, text: str) -> RunSettings:
    """The settings in the text of a file. Cached: a command reads its settings many times, and PyYAML takes tens of
    milliseconds for each (its parser in C crashes on deeply nested brackets)."""
    try:
        settings = load_yaml(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise _not_yaml(path, error) from error
    missing = [name for name in SECTIONS if not isinstance(settings, dict) or name not in settings]
    if missing:  # a part of a file may be YAML too: defaults in place of the rest would train another scene
        raise RunError(
            f"{path}: is damaged or not of a vdgs run (no `{missing[0]}`). Put a whole copy there, or begin "
            "another run: vdgs run CAPTURE --output RUN"
        )
    settings.pop("vdgs", None)
    try:
        return RunSettings.from_dict(settings)
    except (ValueError, TypeError) as error:
        raise RunError(
            f"{path}: {error}. Correct the file; a run of another version cannot be continued, but begun anew: "
            "vdgs run CAPTURE --output RUN"
        ) from error


def _is_of_another_run(command: str, folder: Path) -> bool:
    """Whether a command names the absolute path of another folder as its output: this folder is a copy."""
    try:
        words = shlex.split(command)
    except ValueError:
        return True
    outputs = [after for word, after in pairwise(words) if word == "--output"]
    outputs += [word.removeprefix("--output=") for word in words if word.startswith("--output=")]
    return any(os.path.isabs(each) and os.path.realpath(each) != os.path.realpath(folder) for each in outputs)


def git_commit() -> str | None:
    """The commit of the checkout that this package runs from; None outside a checkout of vdgs."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists() or not (root / "CMakeLists.txt").exists():
        return None
    command = ["git", "-C", str(root), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() or None
    except OSError:  # no git on this machine
        return None


class _Loader(yaml.SafeLoader):
    """Plain values only, each with a name of its own: of two of one name YAML would take the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if twice := [name for name, count in names.items() if count > 1]:
            raise yaml.constructor.ConstructorError(None, None, f"{twice[0]} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)

    def construct_yaml_float(self, node: yaml.ScalarNode) -> Any:
        """A number, but 30.000 as it is written: where a whole number is asked for, it is thirty thousand to many."""
        number = super().construct_yaml_float(node)
        return node.value if ":" in node.value or re.fullmatch(r"[+-]?\d+\.\d{3}", node.value) else number

    def construct_yaml_int(self, node: yaml.ScalarNode) -> Any:
        """A number, but 010 and 1:30 as they are written: YAML takes them for 8 and 90."""
        return node.value if re.match(r"[+-]?0\d|.*:", node.value) else super().construct_yaml_int(node)


_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def yaml_fault(error: Exception) -> str:
    """What is wrong with a text, and where: line 2, column 1: found character '\\t' that cannot start any token."""
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None)
    return f"line {mark.line + 1}, column {mark.column + 1}: {problem}" if mark and problem else str(error)


def load_yaml(text: str) -> Any:
    """What YAML says. Raises YAMLError, ValueError or RecursionError for what is none, and for names given twice."""
    return yaml.load(text, _Loader)  # a SafeLoader: makes plain values only, and runs nothing
