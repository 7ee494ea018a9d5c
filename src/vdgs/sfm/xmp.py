"""The plain values of XMP, the XML that drones write into photographs.

Read by patterns, not by an XML parser: nothing is expanded, nested or fetched, so that no file can make it large. Every
pattern is bounded, and so is what is looked at.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from itertools import islice
from xml.sax.saxutils import unescape

from vdgs.captures.xmp_packets import as_utf8

#: Values that a packet may have; more are not looked at.
MAX_VALUES = 2000
_NAME = r"[A-Za-z_][\w.-]{0,63}"
_ATTRIBUTE = re.compile(
    rf"({_NAME}):({_NAME})[ \t\r\n]{{0,16}}=[ \t\r\n]{{0,16}}(?:\"([^\"<]{{0,400}})\"|'([^'<]{{0,400}})')"
)
_ELEMENT = re.compile(rf"<({_NAME}):({_NAME})(?:[ \t\r\n][^<>]{{0,200}})?>([^<]{{0,400}})</")
#: Structures whose fields have names that others have too (Skydio): how the camera lies, north, east, down; its lens.
_STRUCTURE = re.compile(rf"<{_NAME}:(CameraOrientationNED|CalibratedFocalLength|CalibratedOpticalCenter)\b")
_STRUCTURE_BYTES, _MOST_STRUCTURES = 600, 8
#: Structures about something else than the photograph and its camera: what is shown, other files, regions, edits.
_ELSEWHERE = re.compile(
    rf"<({_NAME}:(?:LocationShown|LocationCreated|EventLocation|ArtworkOrObject|ImageRegion|Regions|RegionInfo|Pantry"
    r"|Ingredients|DerivedFrom|ManagedFrom|History|Look|MaskGroupBasedCorrections))\b"
)
#: The band of a multispectral camera, as a list; color photographs list three.
_BAND = re.compile(
    r"<(Camera:BandName)>\s{0,200}<rdf:(?:Seq|Bag)>((?:\s{0,200}<rdf:li>[^<]{0,100}</rdf:li>){1,8})\s{0,200}</rdf:(?:Seq|Bag)>"
)
#: What XML writes for quotes, besides `&lt;`, `&gt;` and `&amp;`.
_QUOTES = {"&quot;": '"', "&apos;": "'"}
_ITEM = re.compile(r"<rdf:li>([^<]{0,100})<")


def read_xmp(packet: bytes) -> dict[str, str]:
    """Attributes and elements without children by `prefix:Name`, prefixes as they are in the file; {} for nonsense."""
    text = _of_photograph(as_utf8(packet).decode("utf-8", errors="replace"))
    found: dict[str, str] = {}
    for prefix, name, value in _values(text):
        if prefix != "xmlns" and len(found) < MAX_VALUES:
            found.setdefault(f"{prefix}:{name}", value)
    band = _BAND.search(text)
    if band and len(names := _ITEM.findall(band[2])) == 1:
        found.setdefault(band[1], names[0].strip())
    for structure in islice(_STRUCTURE.finditer(text), _MOST_STRUCTURES):
        body = text[structure.end() : structure.end() + _STRUCTURE_BYTES].partition(structure[1])[0]
        head = body.partition(">")[0]
        for _, name, value in _values(head if head.endswith("/") else body):
            found.setdefault(f"{structure[1]}:{name}", value)
    return found


def _of_photograph(text: str) -> str:
    """The packet without structures about something else, whose fields have the same names; one that does not end ends
    the packet."""
    kept, at = [], 0
    while start := _ELSEWHERE.search(text, at):
        kept.append(text[at : start.start()])
        opened = text.find(">", start.end())
        if opened >= 0 and text[opened - 1] == "/":
            at = opened + 1
            continue
        end = f"</{start[1]}>"
        closed = text.find(end, opened) if opened >= 0 else -1
        at = closed + len(end) if closed >= 0 else len(text)
    return "".join([*kept, text[at:]])


def _values(text: str) -> Iterator[tuple[str, str, str]]:
    for pattern in (_ATTRIBUTE, _ELEMENT):
        for match in pattern.finditer(text):
            prefix, name, *values = match.groups()
            value = next((each for each in values if each is not None), "").strip()
            yield prefix, name, unescape(value, _QUOTES)


def text(values: Mapping[str, str], *names: str) -> str:
    """The first of these values; a name without a prefix is that of any maker (`drone-dji:`, `drone-parrot:`, ...)."""
    return next(_found(values, names), "")


def first_number(values: Mapping[str, str], *names: str) -> float | None:
    """The first of these values that is a finite number, such as "+39.80", with a unit behind it or as a fraction."""
    for written in _found(values, names):
        value = _number(written)
        if value is not None and abs(value) < 1e12:  # false for NaN too
            return value
    return None


def _found(values: Mapping[str, str], names: tuple[str, ...]) -> Iterator[str]:
    for name in names:
        if ":" in name:
            if name in values:
                yield values[name]
        else:
            yield from (value for key, value in values.items() if key.partition(":")[2].lower() == name.lower())


def _number(written: str) -> float | None:
    words = written.replace("\u2212", "-").split()
    numerator, slash, denominator = (words[0] if words else "").rstrip("m°").partition("/")
    try:
        return float(numerator) / float(denominator) if slash else float(numerator)
    except (ValueError, ZeroDivisionError):
        return None
