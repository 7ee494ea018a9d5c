"""Commands that messages advise, as a person copies them."""

from __future__ import annotations

import re
import shlex


def advised_words(pattern: str, said: str) -> list[str | None]:
    """The words of a command in a message: a regular expression in which WORD stands for a word of the shell, quoted
    where it must be. None for words of an optional part that is not there. Fails where the message has no such
    command."""
    command = re.search(pattern.replace("WORD", r"('[^']*'|\S+)"), said)
    assert command is not None, said
    return [word and shlex.split(word)[0] for word in command.groups()]
