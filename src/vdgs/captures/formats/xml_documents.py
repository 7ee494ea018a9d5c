"""XML files of other programs, alone or zipped, read piece by piece: no entities, no document types, whatever their
size."""

from __future__ import annotations

import codecs
import math
import os
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, cast
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from vdgs.errors import CaptureError

#: Bytes that are read at once, and that are looked at to tell what a file is.
CHUNK_BYTES, HEAD_BYTES = 1 << 20, 4096
#: What is looked for in files is not longer.
_OVERLAP_BYTES = 512
#: Files that are a zip with an XML file in it, which is called so where there are several.
_ZIPPED, _DOCUMENT = (".xmlz", ".zip", ".psz"), "doc.xml"
#: Elements lie in no more others than this; text and attributes of one are no longer than this.
MAX_DEPTH, MAX_TEXT = 64, 1 << 24
_DECLARATION = re.compile(rb"^\s*(\xef\xbb\xbf)?<\?xml[^>]*\?>")
_ENCODING = re.compile(rb"^\s*<\?xml[^>]*\bencoding\s*=\s*[\"']([\w.-]+)")
#: Encodings of Chinese, Japanese and Korean, by how their names begin.
_OF_SEVERAL_BYTES = ("gb", "big5", "shift", "sjis", "euc", "iso-2022", "cp93", "cp94", "cp950", "ms932", "ks_c")
_ROOT = re.compile(r"<(?:\w+:)?([A-Za-z_][\w.-]*)[\s/>]")


def files_ending(folder: Path, *endings: str) -> list[Path]:
    """What a folder holds under names with these endings (lower case), in order. Folders above an output may hold
    thousands of others."""
    with os.scandir(folder) as entries:
        names = sorted(entry.name for entry in entries if entry.name.lower().endswith(endings))
    return [folder / name for name in names]


def root_element(file: Path) -> str:
    """The name of the first element of an XML file; empty for files of other kinds and those that cannot be read."""
    try:
        with _opened(file) as stream:
            head = stream.read(HEAD_BYTES)
    except (OSError, CaptureError):
        return ""
    text = head.decode("utf-8", "replace").lstrip("\ufeff \r\n\t")
    found = _ROOT.search(text) if text.startswith("<") else None
    return found[1] if found else ""


def holds(file: Path, *texts: bytes) -> bool:
    """Whether a file holds all of these texts, wherever; not so where it cannot be read."""
    missing = set(texts)
    for part in _parts(file):
        missing -= {text for text in missing if text in part}
        if not missing:
            return True
    return False


def holds_match(file: Path, pattern: re.Pattern[bytes]) -> bool:
    """Whether a file holds what a pattern of less than some hundred bytes matches; not so where it cannot be read."""
    return any(pattern.search(part) for part in _parts(file))


def _parts(file: Path) -> Iterator[bytes]:
    """A file in parts that overlap; none more from where it cannot be read."""
    kept = b""
    try:
        with _opened(file) as stream:
            while block := stream.read(CHUNK_BYTES):
                yield kept + block
                kept = block[-_OVERLAP_BYTES:]
    except (OSError, CaptureError):
        return


@contextmanager
def _opened(file: Path) -> Iterator[IO[bytes]]:
    """A file, or the first XML file in it where it is a zip; in UTF-8 if it is in UTF-16, or in an encoding of several
    bytes, which expat does not know."""
    with file.open("rb") as plain:
        if file.suffix.lower() not in _ZIPPED:
            yield _in_utf8(plain)
            return
        try:
            with zipfile.ZipFile(plain) as archive:
                names = [name for name in archive.namelist() if name.lower().endswith(".xml")]
                if not names:
                    raise CaptureError(f"{file}: holds no XML file.")
                with archive.open(_DOCUMENT if _DOCUMENT in names else names[0]) as stream:
                    yield _in_utf8(stream)
        # What zipfile raises for a damaged file, a compression that it lacks (NotImplementedError) and a password.
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError, zlib.error, EOFError) as error:
            raise CaptureError(f"{file}: is no zip file that can be read ({error}). Copy it again.") from None


def _in_utf8(stream: IO[bytes]) -> IO[bytes]:
    head = stream.read(HEAD_BYTES)
    stream.seek(0)
    zeros = [place for place in (0, 1) if head[place : place + 1] == b"\0"]
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif zeros:  # without a mark: `<` has a zero before or behind it
        encoding = "utf-16-le" if zeros == [1] else "utf-16-be"
    else:
        named = _ENCODING.search(head)
        encoding = named[1].decode("ascii").lower() if named else ""
        if not encoding.startswith(_OF_SEVERAL_BYTES) or not _is_known(encoding):
            return stream
    return cast(IO[bytes], codecs.EncodedFile(cast(Any, stream), "utf-8", encoding, "replace"))


def _is_known(encoding: str) -> bool:
    try:
        return bool(codecs.lookup(encoding))
    except LookupError:
        return False


def read_xml(
    file: Path, each: Mapping[str, Callable[[Element], None]] | None = None, *, fragment: bool = False
) -> Element:
    """The root of an XML file, or where it is a `fragment` without one, an element around all that it holds. An element
    named in `each` is handed over once it is whole and then dropped, so that long lists take no memory.

    Raises `CaptureError` for files that cannot be read, are cut off, damaged or no XML, or declare a document type
    (entities could make a small file fill the memory, or read others).
    """
    return _Reader(file, each or {}).read(fragment)


class _Reader:
    def __init__(self, file: Path, each: Mapping[str, Callable[[Element], None]]) -> None:
        self._file, self._each, self._builder = file, each, TreeBuilder()
        self._open: list[Element] = []
        self._text = 0

    def read(self, fragment: bool) -> Element:
        try:
            with _opened(self._file) as stream:
                parser = self._parser("utf-8" if isinstance(stream, codecs.StreamRecoder) else None)
                if fragment:
                    parser.Parse(b"<fragment>" + _DECLARATION.sub(b"", stream.read(CHUNK_BYTES)), False)
                while block := stream.read(CHUNK_BYTES):
                    parser.Parse(block, False)
                parser.Parse(b"</fragment>" if fragment else b"", True)
            return self._builder.close()
        except OSError as error:
            raise CaptureError(f"{self._file}: cannot be read ({error.strerror or error}).") from error
        except (expat.ExpatError, AssertionError, LookupError, ValueError) as error:
            raise CaptureError(f"{self._file}: is no whole XML file ({error}). Export or copy it again.") from None

    def _parser(self, encoding: str | None) -> expat.XMLParserType:
        """A parser of an encoding; None: of that which the file declares."""
        parser = expat.ParserCreate(encoding)
        parser.buffer_text = True
        parser.StartElementHandler, parser.EndElementHandler = self._start, self._end
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = self._data, self._refuse
        return parser

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self._open) >= MAX_DEPTH or (attributes and sum(map(len, attributes.values())) > MAX_TEXT):
            raise self._strange("elements in elements, or attributes, without end")
        self._text = 0
        self._open.append(self._builder.start(_without_prefix(name), attributes))

    def _end(self, name: str) -> None:
        self._text = 0
        element = self._builder.end(_without_prefix(name))
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


def _without_prefix(name: str) -> str:
    return name.rpartition(":")[2] if ":" in name else name


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
    text = parent.findtext(name)
    if not text or text.isspace():
        if default is not None:
            return default
        raise CaptureError(f"{file}: {label} has no {name}. Export the file again.")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    return value if math.isfinite(value) else xml_numbers(text, 1, file, f"{name} of {label}")[0]
