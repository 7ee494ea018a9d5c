"""What follows `next: ` in the output of a verb, taken as a shell takes it and read by the verbs' own parsers."""

from __future__ import annotations

import shlex
from unittest.mock import patch

from vdgs.cli import capture_cmds, common, export_cmd, result_cmds, run_cmd, stage_cmds
from vdgs.cli.main import COMMANDS, get_command

MODULES = (capture_cmds, common, export_cmd, result_cmds, run_cmd, stage_cmds)


class _Parsed(Exception):
    """The arguments of a command were accepted."""


def next_commands(output: str) -> list[str]:
    """The commands after `next: `, each of which a shell and its verb accept."""
    lines = [line.removeprefix("next: ") for line in output.splitlines() if line.startswith("next: ")]
    commands = [command.strip() for line in lines for command in line.split("&&")]
    for command in commands:
        words = shlex.split(command)
        assert words[0] in ("vdgs", "rm"), command
        if words[0] == "vdgs":
            parse(words[1:])
    return commands


def parse(words: list[str]) -> None:
    """Let a verb read its arguments, and no more. SystemExit where it refuses them."""
    assert words[0] in COMMANDS, words

    def read(*arguments: object, **options: object) -> object:
        common_parse(*arguments, **options)
        raise _Parsed

    common_parse = common.parse_arguments
    patches = [
        patch.object(module, "parse_arguments", read) for module in MODULES if hasattr(module, "parse_arguments")
    ]
    for each in patches:
        each.start()
    try:
        get_command(words[0])(words[1:])
    except _Parsed:
        return
    finally:
        for each in patches:
            each.stop()
    raise AssertionError(f"{words} was not parsed")
