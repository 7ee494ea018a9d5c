"""XML files of other programs, read piece by piece: no entities, no document types, whatever their size."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from vdgs.errors import CaptureError

#: Bytes that are read at once, and that are looked at to tell what a file is.
CHUNK_BYTES, HEAD_BYTES = 1 << 20, 4096
#: Elements lie in no more others than this; text and attributes of one are no longer than this.
MAX_DEPTH, MAX_TEXT = 64, 1 << 24
_ROOT = re.compile(r"<(?:\w+:)?([A-Za-z_][\w.-]*)[\s/>]")


def root_element(file: Path) -> str:
    """The name of the first element of an XML file; empty for files of other kinds and those that cannot be read."""
    try:
        with file.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError:
        return ""
    text = head.decode("utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", "replace").lstrip(
        "\ufeff \r\n\t"
    )
    found = _ROOT.search(text) if text.startswith("<") else None
    return found[1] if found else ""


def read_xml(file: Path, each: Mapping[str, Callable[[Element], None]] | None = None) -> Element:
    """The root of an XML file. An element named in `each` is handed over once it is whole and then dropped, so that
    long lists take no memory.

    Raises `CaptureError` for files that cannot be read, are cut off, damaged or no XML, or declare a document type
    (entities could make a small file fill the memory, or read others).
    """
    return _Reader(file, each or {}).read()


class _Reader:
    def __init__(self, file: Path, each: Mapping[str, Callable[[Element], None]]) -> None:
        self._file, self._each, self._builder = file, each, TreeBuilder()
        self._open: list[Element] = []
        self._text = 0

    def read(self) -> Element:
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = self._data, self._refuse
        try:
            with self._file.open("rb") as stream:
                while block := stream.read(CHUNK_BYTES):
                    parser.Parse(block, False)
            parser.Parse(b"", True)
            return self._builder.close()
        except OSError as error:
            raise CaptureError(f"{self._file}: cannot be read ({error.strerror or error}).") from error
        except (expat.ExpatError, AssertionError, LookupError, ValueError) as error:
            raise CaptureError(f"{self._file}: is no whole XML file ({error}). Export or copy it again.") from None

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self._open) >= MAX_DEPTH or sum(map(len, attributes.values())) > MAX_TEXT:
            raise self._strange("elements in elements, or attributes, without end")
        self._text = 0
        self._open.append(self._builder.start(name.rpartition(":")[2], attributes))

    def _end(self, name: str) -> None:
        self._text = 0
        element = self._builder.end(name.rpartition(":")[2])
        self._open.pop()
        handle = self._each.get(element.tag)
        if handle is not None and self._open:
            handle(element)
            self._open[-1].remove(element)

    def _data(self, text: str) -> None:
        self._text += len(text)
        if self._text > MAX_TEXT:
            raise self._strange("text without end")
        self._builder.data(text)

    def _refuse(self, *_: object) -> None:
        raise self._strange("a document type")

    def _strange(self, what: str) -> CaptureError:
        return CaptureError(f"{self._file}: holds {what}, as no program writes it. It is not read.")


def xml_numbers(text: str | None, count: int | None, file: Path, label: str) -> list[float]:
    """The finite numbers of a text, `count` of them. Raises `CaptureError` for anything else."""
    try:
        found = [float(word) for word in (text or "").replace(",", " ").split()]
    except ValueError:
        found = [math.nan]
    if (count is not None and len(found) != count) or not all(map(math.isfinite, found)):
        raise CaptureError(
            f"{file}: {label} must be {'numbers' if count is None else f'{count} number' + 's' * (count > 1)}, not "
            f"{(text or '').strip()[:60]!r}. The file is damaged; export it again."
        )
    return found


def xml_number(parent: Element, name: str, file: Path, label: str, default: float | None = None) -> float:
    """The number in a child element. Raises `CaptureError` where it is none, or is missing and has no default."""
    child = parent.find(name)
    if child is None or not (child.text or "").strip():
        if default is not None:
            return default
        raise CaptureError(f"{file}: {label} has no {name}. Export the file again.")
    return xml_numbers(child.text, 1, file, f"{name} of {label}")[0]
