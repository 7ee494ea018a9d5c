"""The help of a verb: what people set, a line each; with `--help-all` every option, in full."""

from __future__ import annotations

import inspect
import shutil
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from vdgs.config.options import Option, options_of, value_at, value_words

#: What `--help` shows of verbs that have too many options, by group. All options of other verbs are shown.
COMMON_OPTIONS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "run": {
        "input": ("--capture", "--extra-image-folders", "--gps", "--format"),
        "output": ("--output", "--ortho", "--dry-run", "--quiet"),
        "size": ("--images", "--downscale", "--max-images"),
        "preset and settings": ("--preset", "--config", "--iterations", "--block.iterations", "--seed"),
        "blocks": ("--blocks", "--block-memory-gb", "--jobs", "--executor"),
        "resume": ("--overwrite", "--allow-missing-blocks", "--save-every"),
        "machine": ("--threads", "--device", "--image-cache-gb"),
    },
    "train-coarse": {
        "input": ("--capture", "--gps", "--format"),
        "output": ("--output", "--quiet"),
        "size": ("--images", "--downscale", "--max-images"),
        "preset and settings": ("--preset", "--config", "--iterations", "--densify.max-anchors", "--seed"),
        "resume": ("--save-every",),
        "machine": ("--threads", "--device", "--image-cache-gb"),
    },
    "config": {
        "output": ("--output",),
        "what it starts from": ("--preset", "--config"),
        "settings people set": ("--images", "--downscale", "--iterations", "--blocks", "--block.iterations"),
    },
    "partition": {
        "input": ("--run", "--capture"),
        "blocks": ("--blocks", "--block-memory-gb", "--lambda-vis", "--balanced", "--expansion", "--strategy"),
        "cameras": ("--assignment.mode", "--assignment.threshold", "--assignment.min-cameras", "--explain"),
        "resume": ("--overwrite",),
        "machine": ("--jobs", "--executor", "--threads", "--device", "--quiet"),
    },
    "train-blocks": {
        "input": ("--run", "--capture"),
        "blocks": ("--block", "--jobs", "--executor"),
        "settings": ("--block.iterations", "--block.densify.max-anchors", "--block.max-anchors-total"),
        "resume": ("--overwrite", "--save-every"),
        "machine": ("--threads", "--device", "--image-cache-gb", "--quiet"),
    },
}  # fmt: skip
#: Options of a cluster, and others that few need: in the full help alone.
RARE_OPTIONS = (
    "--address", "--cpus", "--mem-gb", "--gpus", "--min-visibility", "--antialiasing", "--num-off-path-images",
    "--background", "--moving-water",
)  # fmt: skip

#: The short help fits its explanations into a line of so many columns, and wraps them on narrower terminals.
LINE_WIDTH = 100
MIN_WIDTH, MAX_WIDTH = 60, 120
#: Columns of names in the short help at most, before their explanation.
MAX_NAME_WIDTH = 28


def help_text(verb: str, kind: type, settings: Any, *, full: bool) -> str:
    """The help of a verb; `settings` holds the defaults that it shows."""
    width = min(max(shutil.get_terminal_size((LINE_WIDTH, 24)).columns, MIN_WIDTH), MAX_WIDTH)
    options = options_of(kind)
    free = " ".join(each.metavar for each in options if each.is_positional)
    named = " ".join(f"{each.flag} {each.metavar}" for each in options if each.is_required and not each.is_positional)
    lines = [" ".join(f"usage: vdgs {verb} {free} {named} [options]".split()), ""]
    paragraphs = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    for text in paragraphs if full else paragraphs[:1]:
        lines += [*textwrap.wrap(" ".join(text.split()), width), ""]
    groups = _all_groups(options) if full else _common_groups(verb, options)
    for title, members in groups.items():
        lines += [f"{title}:", *_entries(members, settings, width, full), ""]
    hidden = len(options) - sum(map(len, groups.values()))
    if hidden:
        lines += textwrap.wrap(f"{hidden} more options and all explanations: vdgs {verb} --help-all", width)
        if any(each.flag == "--sfm.gcp" for each in options):
            text = "Options of `vdgs sfm`, for photographs, start with --sfm. here, such as --sfm.gcp gcp_list.txt."
            lines += textwrap.wrap(text, width)
        if any(each.flag == "--config" for each in options):
            lines += textwrap.wrap(
                "Settings in a file: `vdgs config --output settings.yaml` writes all of them with comments, "
                f"`vdgs {verb} --config settings.yaml` reads it. The file wins over the preset, options over the file.",
                width,
            )
    elif not full:
        lines += textwrap.wrap(f"all explanations: vdgs {verb} --help-all", width)
    return "\n".join(lines).rstrip() + "\n"


def _common_groups(verb: str, options: tuple[Option, ...]) -> dict[str, list[Option]]:
    by_flag = {each.flag: each for each in reversed(options)}
    if verb in COMMON_OPTIONS:
        return {title: [by_flag[flag] for flag in flags] for title, flags in COMMON_OPTIONS[verb].items()}
    shown = [each for each in options if "slurm" not in each.path and each.flag not in RARE_OPTIONS]
    first = [each for each in shown if each.is_positional or each.is_required or each.flag == "--output"]
    groups = {"arguments": first, "options": [each for each in shown if each not in first]}
    return {title: members for title, members in groups.items() if members}


def _all_groups(options: tuple[Option, ...]) -> dict[str, list[Option]]:
    """Every option, by the groups in their names."""
    groups: dict[str, list[Option]] = {}
    for option in sorted(options, key=lambda each: not each.is_positional):
        within = option.flag.removeprefix("--").rpartition(".")[0]
        title = "arguments" if option.is_positional else f"{within} options" if within else "options"
        groups.setdefault(title, []).append(option)
    return groups


def _entries(options: list[Option], settings: Any, width: int, full: bool) -> Iterator[str]:
    names = [_name(each, full) for each in options]
    indent = 8 if full else 2 + MAX_NAME_WIDTH + 2
    room = LINE_WIDTH - indent
    for option, name in zip(options, names, strict=True):
        default = _default(option, settings)
        text = option.help if full else option.summary(room - len(default))
        lines = textwrap.wrap(text + default, width - indent, break_on_hyphens=False)
        if full or len(name) > MAX_NAME_WIDTH:
            yield from textwrap.wrap(name, width - 2, initial_indent="  ", subsequent_indent="      ")
        else:
            yield f"  {name:<{indent - 2}}{lines.pop(0) if lines else ''}".rstrip()
        yield from (" " * indent + line for line in lines)


def _name(option: Option, full: bool) -> str:
    """An option with what it takes, as help lists it."""
    if option.is_positional:
        return option.metavar
    names = option.flags if full or option.flag == "--output" else (option.flag,)
    if option.num_words == 0 and full:
        names = (*names, option.off_flag)
    name = f"{', '.join(names)} {option.metavar}".rstrip()
    return name if full or "{" not in name else f"{', '.join(names)} NAME"


def _default(option: Option, settings: Any) -> str:
    """The default at the end of an explanation; nothing where there is none, or where help says what 0 does."""
    if option.is_required:
        return " (required)" if not option.is_positional else ""
    value = value_at(settings, option.path)
    if option.num_words == 0:
        return f" (default: on; off: {option.off_flag})" if value else ""
    explained = value == 0 and "; 0" in option.help
    return "" if explained or value in (None, (), "") else f" (default: {value_words(value)})"
