"""What follows `next: ` in the output of a verb, taken as a shell takes it and read by the verbs' own parsers."""

from __future__ import annotations

import shlex

from vdgs.cli.argument_parser import parse_words
from vdgs.cli.main import verb_arguments


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
    """Let a verb read its arguments, and no more. Raises UsageError or VdgsError where it refuses them."""
    kind = verb_arguments()[words[0]]
    assert kind is not None, words
    parse_words(kind, words[1:]).check()
