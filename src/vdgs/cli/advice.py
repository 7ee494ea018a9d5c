"""Advice in messages fitted to the verb that prints them: the rooms below do not know which options it has."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache

from vdgs.config.options import options_of

#: An option in a text; `--lr.*` is a whole group.
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9]*(?:[.-][a-z0-9]+)*(?:\.\*)?")
#: A command in a text, up to the end of its sentence or of its quotation.
COMMAND = re.compile(r"vdgs ([a-z][a-z-]*)\b(?:(?!\. |[`;:\n]|, or ).)*")
#: The command that tells a run where its capture lies now (`RunFolder.missing_capture`), with the run.
CAPTURE_COMMAND = re.compile(r"vdgs visibility (.+?) --capture PATH")
#: How the verb that runs changes its messages (`Advice.fit`).
MESSAGE_FIT: ContextVar[Callable[[str], str]] = ContextVar("MESSAGE_FIT", default=str)


@cache
def flags_of(kind: type | None) -> frozenset[str]:
    """Every option of a verb by the dataclass of its arguments, and its groups."""
    options = options_of(kind) if kind is not None else ()
    flags = {flag for each in options for flag in (*each.flags, *([each.off_flag] if each.num_words == 0 else []))}
    groups = {f"{flag.rpartition('.')[0]}.*" for flag in flags if "." in flag}
    return frozenset({*flags, *groups, "--help", "--help-all"})


@dataclass(frozen=True)
class Advice:
    """The messages of a verb among others."""

    verb: str
    kinds: Callable[[], Mapping[str, type | None]]
    """The dataclass of the arguments of every verb."""

    def fit(self, text: str) -> str:
        """A message that names no option as the verb's own which it lacks: one that the verb has in a group is named by
        it (`--sfm.focal` in `vdgs run`), and of others it says which verbs have them. Where the capture of a run lies,
        the verb itself takes if it can."""
        if "--" not in text:
            return text
        own = flags_of(self.kinds()[self.verb])
        if "--capture" in own:
            text = CAPTURE_COMMAND.sub(rf"vdgs {self.verb} \1 --capture PATH", text)
        commands = [each.span() for each in COMMAND.finditer(text) if each.group(1) in self.kinds()]
        foreign: dict[str, str] = {}

        def fitted(found: re.Match[str]) -> str:
            flag = found.group()
            if flag in own or any(start <= found.start() < end for start, end in commands):
                return flag
            grouped = [each for each in own if each.endswith(f".{flag.removeprefix('--')}")]
            if len(grouped) == 1:
                return grouped[0]
            if owners := self._owners(flag):
                foreign[flag] = owners
            return flag

        text = OPTION.sub(fitted, text)
        notes = _joined([f"{flag} of {owners}" for flag, owners in foreign.items()])
        return f"{text.rstrip()} ({notes})" if foreign else text

    def _owners(self, flag: str) -> str:
        """The verbs that have an option, in words; empty where none has it."""
        owners = [verb for verb, kind in self.kinds().items() if flag in flags_of(kind)]
        owners = [verb for verb in ("run", "partition", "train-blocks") if verb in owners] or owners
        return _joined([f"`vdgs {verb}`" for verb in owners[:2]])


def _joined(words: Iterable[str]) -> str:
    *first, last = [*words] or [""]
    return f"{', '.join(first)} and {last}" if first else last
