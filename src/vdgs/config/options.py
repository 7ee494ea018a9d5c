"""The options of a command, read from the fields of a dataclass: names, types, help and defaults, and their words.

    blocks: Annotated[int | Literal["auto"], Range(1, 10_000)] = 8
    \"\"\"K, the number of blocks.\"\"\"

is `--blocks`. A field that holds a dataclass is a group, whose name (`FlagName`) begins the names of its options.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import sys
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from vdgs.config.number_words import how_to_write, plain_number
from vdgs.config.ranges import FlagName, Positional, Repeatable, to_flag
from vdgs.config.type_hints import describe_type, field_hints, without_notes
from vdgs.config.typed_paths import expand_home

#: Other names of an option: shorter ones, and those that scripts of before use.
ALIASES = {
    "--output": ("-o", "--out"), "--max-num-features": ("--features",), "--num-images": ("--images",),
    "--num-test-images": ("--test-images",), "--num-validation-images": ("--validation-images",),
}  # fmt: skip

#: Values by the names of the fields down to them.
Values = dict[tuple[str, ...], Any]


@dataclass(frozen=True, kw_only=True)
class Option:
    """One option, or one argument without a name."""

    path: tuple[str, ...]
    """Names of the fields down to it."""
    flag: str
    hint: Any
    help: str
    positional: Positional | None = None
    is_repeatable: bool = False
    is_required: bool = False

    @property
    def is_positional(self) -> bool:
        return self.positional is not None

    @property
    def num_words(self) -> int | None:
        """How many words follow its name; None for any number."""
        return 0 if without_notes(self.hint) is bool else count_words(self.hint)

    @property
    def flags(self) -> tuple[str, ...]:
        """All its names; none for an argument without a name."""
        return () if self.is_positional and self.flag not in ALIASES else (*ALIASES.get(self.flag, ()), self.flag)

    @property
    def off_flag(self) -> str:
        """The name that switches it off: `--init.no-mvs`."""
        return off_flag(self.flag)

    @property
    def metavar(self) -> str:
        """What stands for its value in help: PATH, INT, {auto,cpu}; the argument itself where it has no name."""
        if self.positional is not None:
            name = self.positional.name or self.flag.removeprefix("--").upper()
            return name if self.num_words is not None else f"{name} ..." if self.is_required else f"[{name} ...]"
        if self.is_repeatable:
            return _metavar(typing.get_args(without_notes(self.hint))[0])
        return _metavar(self.hint)

    def summary(self, width: int) -> str:
        """The first sentence of its help, or as many clauses of it as fit into a width, if one does; with the values
        to choose from, as many as two lines hold."""
        first = self.help.split(". ")[0].rstrip(".")
        if choices := _choices(without_notes(self.hint)):
            head, shown = re.split("[:;]", first)[0], len(choices)
            while shown > 1 and len(f"{head}: {', '.join(choices[:shown])}, ...") > 2 * width:
                shown -= 1
            return f"{head}: {', '.join((*choices[:shown], *(['...'] if shown < len(choices) else [])))}"
        if len(first) <= width:
            return first
        # A clause ends neither within a list or brackets nor before what a value means, as in "; 0: all".
        outside = re.sub(r"\(.*?\)", lambda found: "_" * len(found[0]), first)
        ends = [found.start() for found in re.finditer(r"(?<!; 0)[:;] | _+$", outside)]
        return first[: max([end for end in ends if end <= width] or [len(first)])]

    def read(self, words: Sequence[str]) -> Any:
        """The value that words say. Raises ValueError, in words that follow the name, for others."""
        count = self.num_words or 0
        if len(words) == 1 and count > 2 and words[0].count(",") == count - 1:  # as GIS programs write boxes
            words = words[0].split(",")
        try:
            plain = [plain_number(expand_home(word, self.hint), self.flag, self.hint) for word in words]
            return read_words(self.hint, plain)
        except ValueError:
            said, kind = " ".join(words).strip(), describe_type(self.hint).removesuffix(" or null")
            how = how_to_write(said, self.flag, self.hint)
            raise ValueError(f"{said}: must be {kind}{how}" if said else f"needs a value: {kind}") from None


def option_words(flag: str, words: Sequence[str]) -> list[str]:
    """An option and its values as a command line has them: a value that looks like an option is joined to it."""
    return [f"{flag}={words[0]}"] if len(words) == 1 and words[0].startswith("-") else [flag, *words]


def off_flag(flag: str) -> str:
    """The name that switches an option off."""
    *groups, last = flag.removeprefix("--").split(".")
    return "--" + ".".join([*groups, f"no-{last}"])


@cache
def options_of(kind: type) -> tuple[Option, ...]:
    """Every option of a dataclass, those of its groups included."""
    return tuple(_iter_options(kind, (), ()))


def _iter_options(kind: type, path: tuple[str, ...], names: tuple[str, ...]) -> Iterator[Option]:
    hints = field_hints(kind)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        notes = typing.get_args(hint)[1:] if typing.get_origin(hint) is typing.Annotated else ()
        own = next((note.name for note in notes if isinstance(note, FlagName)), field.name)
        inner = (*names, own) if own else names
        if dataclasses.is_dataclass(without_notes(hint)):
            yield from _iter_options(without_notes(hint), (*path, field.name), inner)
            continue
        has_default = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        yield Option(
            path=(*path, field.name), flag=to_flag(inner), hint=hint, help=field_help(kind, field.name),
            positional=next((note for note in notes if isinstance(note, Positional)), None),
            is_repeatable=any(isinstance(note, Repeatable) for note in notes), is_required=not has_default,
        )  # fmt: skip


def value_at(settings: Any, path: tuple[str, ...]) -> Any:
    """The value of a field of a dataclass or of one inside it."""
    for name in path:
        settings = getattr(settings, name)
    return settings


def with_values(settings: Any, values: Mapping[tuple[str, ...], Any]) -> Any:
    """A dataclass with other values at some paths."""
    own = {path[0]: value for path, value in values.items() if len(path) == 1}
    for name in {path[0] for path in values if len(path) > 1}:
        inner = {path[1:]: value for path, value in values.items() if path[0] == name and len(path) > 1}
        own[name] = with_values(own.get(name, getattr(settings, name)), inner)
    return dataclasses.replace(settings, **own)


@cache
def field_help(kind: type, name: str) -> str:
    """The docstring under a field, of the class that says the most special one; empty where there is none."""
    found = (_field_docs(base.__module__).get((base.__name__, name)) for base in kind.__mro__)
    return next((text for text in found if text), "")


@cache
def _field_docs(module: str) -> dict[tuple[str, str], str]:
    """The docstrings under the fields of all classes of a module."""
    file = getattr(sys.modules[module], "__file__", None)
    tree = ast.parse(Path(file).read_text(encoding="utf-8") if file else "")
    docs = {}
    for each in (node for node in tree.body if isinstance(node, ast.ClassDef)):
        for field, after in pairwise(each.body):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(after, ast.Expr):
                text = after.value.value if isinstance(after.value, ast.Constant) else ""
                docs[each.name, field.target.id] = " ".join(str(text).split())
    return docs


def count_words(hint: Any) -> int | None:
    """How many words a value of a type takes; None for any number."""
    kind, inner = without_notes(hint), typing.get_args(without_notes(hint))
    origin = typing.get_origin(kind)
    if origin is tuple and inner[-1:] == (Ellipsis,):
        return None
    if origin is tuple:
        return sum(count_words(each) or 0 for each in inner)
    if origin in (typing.Union, UnionType):
        counts = [count_words(each) for each in inner]
        return None if None in counts else max(each or 0 for each in counts)
    return 1


def read_words(hint: Any, words: Sequence[str]) -> Any:
    """The value of a type that words say. Raises ValueError for words that say none."""
    kind, inner = without_notes(hint), typing.get_args(without_notes(hint))
    origin = typing.get_origin(kind)
    if origin in (typing.Union, UnionType):
        for each in inner:
            with suppress(ValueError):
                return read_words(each, words)
        raise ValueError
    if origin is tuple:
        kinds: Sequence[Any] = inner
        if inner[-1:] == (Ellipsis,):
            kinds = [inner[0]] * (len(words) // (count_words(inner[0]) or 1))
        sizes = [count_words(each) or 1 for each in kinds]
        if sum(sizes) != len(words):
            raise ValueError
        starts = [sum(sizes[:index]) for index in range(len(sizes))]
        groups = [words[start : start + size] for start, size in zip(starts, sizes, strict=True)]
        return tuple(read_words(each, group) for each, group in zip(kinds, groups, strict=True))
    if len(words) != 1:
        raise ValueError
    return _read_word(kind, words[0])


def _read_word(kind: Any, word: str) -> Any:
    if typing.get_origin(kind) is typing.Literal:
        values = [each for each in typing.get_args(kind) if str(each) == word]  # else as COLMAP writes SIMPLE_RADIAL
        values = values or [each for each in typing.get_args(kind) if str(each) == word.lower().replace("_", "-")]
    elif kind is NoneType:
        values = [None] if word.lower() in ("none", "null") else []
    else:  # a blank word ("$RUN" of a variable that is not set) would be the path of the current folder
        values = [kind(word)] if word.strip() or kind is not Path else []
    if not values:
        raise ValueError
    return values[0]


def _choices(kind: Any) -> list[str]:
    """The words of a Literal, or of one that may be None; empty for other types."""
    if typing.get_origin(kind) in (typing.Union, UnionType) and len(typing.get_args(kind)) == 2:
        kind = next((each for each in typing.get_args(kind) if each is not NoneType), kind)
    return [str(each) for each in typing.get_args(kind)] if typing.get_origin(kind) is typing.Literal else []


def _metavar(hint: Any) -> str:
    kind, inner = without_notes(hint), typing.get_args(without_notes(hint))
    origin = typing.get_origin(kind)
    if origin is typing.Literal:
        return _choices(kind)[0] if len(_choices(kind)) == 1 else "{" + ",".join(_choices(kind)) + "}"
    if origin in (typing.Union, UnionType):
        return "|".join(_metavar(each) for each in inner if each is not NoneType)
    if origin is tuple and inner[-1:] == (Ellipsis,):
        return f"[{_metavar(inner[0])} ...]"
    if origin is tuple:
        return " ".join(_metavar(each) for each in inner)
    return {bool: "", int: "N", float: "NUMBER", str: "NAME"}.get(kind, "PATH")


def value_words(value: Any) -> str:
    """A value as it is typed."""
    if isinstance(value, tuple):
        return " ".join(map(value_words, value))
    return f"{value:g}" if isinstance(value, float) else str(value)
