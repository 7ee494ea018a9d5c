"""The last words of a process, from the file that holds its output."""

from __future__ import annotations

import re
from pathlib import Path

#: Bytes of output that are looked at, and lines that are shown.
TAIL_BYTES, TAIL_LINES = 1 << 16, 12
#: How the command line begins the message of an error (cli.py).
MESSAGE = re.compile(r"vdgs \w+: ")
#: Colours and cursor movements; other control characters.
ESCAPES, CONTROLS = re.compile(r"\x1b\[[0-9;?]*[ -/]*[@-~]"), re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def last_lines(output: Path, start: int = 0) -> list[str]:
    """The last lines after byte `start` that are not empty; none if the file cannot be read."""
    try:
        with output.open("rb") as handle:
            end = handle.seek(0, 2)
            handle.seek(max(start, end - TAIL_BYTES))
            text = handle.read(TAIL_BYTES).decode(errors="replace")
    except OSError:
        return []
    # A carriage return overwrites its line: what follows the last one is what a person saw.
    lines = [line.rstrip("\r\n").rpartition("\r")[2] for line in text.split("\n")]
    clean = [CONTROLS.sub("", ESCAPES.sub("", line)).rstrip() for line in lines]
    return [line for line in clean if line][-TAIL_LINES:]


def explanation(output: Path, start: int = 0) -> str:
    """The message that the command line ended with, else the last line; empty if there is no output."""
    lines = last_lines(output, start)
    for place in reversed(range(len(lines))):
        if MESSAGE.match(lines[place]):
            return "\n".join([MESSAGE.sub("", lines[place]), *lines[place + 1 :]])
    return lines[-1] if lines else ""
