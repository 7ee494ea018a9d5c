"""A file of settings that people write (`vdgs config`, `--config`); config.yaml of a run is one too."""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig
from vdgs.config.options import Values, field_help, with_values
from vdgs.config.ranges import check_ranges
from vdgs.config.serialization import flat_values, to_dict
from vdgs.errors import VdgsError
from vdgs.runs.config_file import load_yaml, yaml_fault
from vdgs.system.atomic_files import write_text

HEADER = """\
# Settings of vdgs. `vdgs run CAPTURE --output RUN --config THIS_FILE` reads them; what is left out keeps its value from
# the preset, and options of the command win over this file.
"""


def read_settings_file(path: Path) -> tuple[Values, Values]:
    """What a file sets: of how the capture is read, and of the method; values by path.

    Raises VdgsError, naming the setting, for one that is unknown, of another type or out of its range.
    """
    if path.is_dir():
        raise VdgsError(f"{path}: is a folder. Give a file of settings: vdgs config --output settings.yaml")
    from vdgs.captures.text_tables import decode_text  # not before a file is asked for: it loads readers of images

    try:
        content = load_yaml(decode_text(path.read_bytes())) or {}
    except (OSError, yaml.YAMLError, RecursionError, ValueError) as error:
        raise VdgsError(f"{path}: cannot be read as YAML ({yaml_fault(error)})") from error
    if not isinstance(content, Mapping):
        raise VdgsError(f"{path}: holds no settings. Write a file to start from: vdgs config --output settings.yaml")
    sections = {key: value for key, value in content.items() if key != "vdgs"}
    header = content.get("vdgs")
    if isinstance(header, Mapping) and (others := sorted(map(str, header.keys() - {"version", "commit", "command"}))):
        raise VdgsError(
            f"{path}: vdgs has no {others[0]!r}: it says what wrote the file. Settings have their own groups."
        )
    capture = sections.pop("capture", None)
    try:
        if isinstance(capture, Mapping):  # config.yaml also says where the capture of its run lies
            capture = {key: value for key, value in capture.items() if key != "path"}
        options = flat_values(CaptureOptions, capture, "capture")
        method = flat_values(MethodConfig, sections, "", also=("capture",))
        check_ranges(with_values(CaptureOptions(), options))
        check_ranges(with_values(MethodConfig(), method))
    except (ValueError, VdgsError) as error:
        raise VdgsError(f"{path}: {error}") from error
    return options, method


def write_settings_file(path: Path | None, options: CaptureOptions, method: MethodConfig, overwrite: bool) -> str:
    """Write all settings to a file; without one they are returned. Raises VdgsError for a file that is there."""
    text = settings_text(options, method)
    if path is None:
        return text
    if path.is_dir() or (path.exists() and not overwrite):
        remedy = "Give the name of a file" if path.is_dir() else "Choose another name, or add --overwrite"
        raise VdgsError(f"--output {path}: is there already. {remedy}.")
    write_text(path, text)
    return ""


def settings_text(options: CaptureOptions, method: MethodConfig) -> str:
    """All settings as YAML, each below a comment that explains it."""
    lines = ["", "# How the capture is read.", "capture:", *_lines(options, 1)]
    for field in dataclasses.fields(method):
        lines += ["", *_comment(field_help(MethodConfig, field.name), 0), f"{field.name}:"]
        lines += _lines(getattr(method, field.name), 1)
    return HEADER + "\n".join(lines) + "\n"


def _lines(settings: Any, depth: int) -> Iterator[str]:
    kind: type = type(settings)
    plain = to_dict(settings)
    for field in dataclasses.fields(settings):
        yield from _comment(field_help(kind, field.name), depth)
        value, indent = getattr(settings, field.name), "  " * depth
        if dataclasses.is_dataclass(value):
            yield f"{indent}{field.name}:"
            yield from _lines(value, depth + 1)
        else:
            text = yaml.safe_dump(plain[field.name], default_flow_style=True, width=1000, allow_unicode=True)
            yield f"{indent}{field.name}: {text.removesuffix(chr(10)).removesuffix('...').rstrip()}"


def _comment(text: str, depth: int) -> list[str]:
    indent = "  " * depth + "# "
    return textwrap.wrap(text, 110, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False)
