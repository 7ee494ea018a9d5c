"""Headers of PLY files, with all of their elements: where each begins, and what its numbers are called."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vdgs.captures.formats.ply_reader import BYTE_ORDERS, MAX_HEADER_BYTES, PLY_DTYPES
from vdgs.errors import VdgsError


@dataclass(frozen=True)
class PlyElement:
    """Rows of one kind."""

    name: str
    count: int
    #: What a row holds, without its lists.
    layout: np.dtype
    #: Whether it has lists, whose lengths only the rows say.
    has_lists: bool


@dataclass(frozen=True)
class PlyHeader:
    """What a file says of itself."""

    path: Path
    #: One of `BYTE_ORDERS`.
    form: str
    elements: tuple[PlyElement, ...]
    #: What follows `comment` and `obj_info`.
    comments: tuple[str, ...]
    #: Where the first element begins, in bytes.
    start: int

    def find(self, name: str) -> tuple[PlyElement, int] | None:
        """An element that has no lists, and where it begins in a binary file. In one of text: how many lines of others
        are before it. None where there is none of that name. Raises VdgsError where that is not known."""
        at = 0 if self.form == "ascii" else self.start
        for element in self.elements:
            if element.has_lists and (element.name == name or (element.count and self.form != "ascii")):
                raise VdgsError(f"{self.path}: has lists in the element {element.name!r}. Write it without.")
            if element.name == name:
                return element, at
            at += element.count * (1 if self.form == "ascii" else element.layout.itemsize)
        return None

    def comment(self, start: str) -> str | None:
        """What follows these words in the first comment that begins with them."""
        return next((each[len(start) :].strip() for each in self.comments if each.startswith(start)), None)


def read_ply_header(path: Path) -> PlyHeader:
    """The header of a file. Raises VdgsError for one that cannot be read, is no PLY, or contradicts itself."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_HEADER_BYTES)
    except OSError as error:
        raise VdgsError(f"{path}: cannot be read ({error.strerror or error}).") from error
    end = data.find(b"\nend_header")
    start = data.find(b"\n", end + 1) + 1
    if not data.startswith(b"ply") or end < 0 or not start:
        raise VdgsError(f"{path}: is no PLY file, or its header is truncated. Write it again.")
    lines = data[:end].decode("latin-1").splitlines()
    form = next((words[1] for words in map(str.split, lines) if words[:1] == ["format"] and len(words) > 1), "")
    if form not in BYTE_ORDERS:
        raise VdgsError(f"{path}: is of format {form!r}. Write it as binary_little_endian.")
    comments = tuple(found[1] for line in lines if (found := re.match(r"(?:comment|obj_info)\s+(.*)", line)))
    return PlyHeader(path, form, _elements(path, lines, BYTE_ORDERS[form]), comments, start)


def _elements(path: Path, lines: list[str], order: str) -> tuple[PlyElement, ...]:
    announced: list[tuple[str, int, dict[str, str]]] = []
    for words in map(str.split, lines):
        if words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"[0-9]{1,15}", words[2]):
                raise VdgsError(f"{path}: its header is damaged ({' '.join(words)!r} says no number). Write it again.")
            announced.append((words[1], int(words[2]), {}))
        elif words[:1] == ["property"]:
            if not announced or len(words) < 3 or not (words[1] in PLY_DTYPES or words[1] == "list"):
                raise VdgsError(f"{path}: has a property that is not understood ({' '.join(words)}). Write it again.")
            element, _, kinds = announced[-1]
            if words[-1] in kinds:
                raise VdgsError(f"{path}: names {words[-1]!r} twice in the element {element!r}. Write it with one.")
            kinds[words[-1]] = words[1]
    return tuple(
        PlyElement(name, count, _layout(kinds, order), "list" in kinds.values()) for name, count, kinds in announced
    )


def _layout(kinds: dict[str, str], order: str) -> np.dtype:
    return np.dtype([(name, order + PLY_DTYPES[kind]) for name, kind in kinds.items() if kind != "list"])
