"""The plain values of XMP, the XML that drones write into photographs.

Read by patterns, not by an XML parser: nothing is expanded, nested or fetched, so that no file can make it large. Every
pattern is bounded, and so is what is looked at.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

#: So much of a packet is looked at; those of drones take a few kB.
MAX_PACKET_BYTES = 1 << 18
#: Values that a packet may have; more are not looked at.
MAX_VALUES = 2000
_NAME = r"[A-Za-z_][\w.-]{0,63}"
_ATTRIBUTE = re.compile(
    rf"({_NAME}):({_NAME})[ \t\r\n]{{0,16}}=[ \t\r\n]{{0,16}}(?:\"([^\"<]{{0,400}})\"|'([^'<]{{0,400}})')"
)
_ELEMENT = re.compile(rf"<({_NAME}):({_NAME})>([^<]{{0,400}})</")


def read_xmp(packet: bytes) -> dict[str, str]:
    """Attributes and elements without children by `prefix:Name`, prefixes as they are in the file; {} for nonsense."""
    text = packet[:MAX_PACKET_BYTES].decode("utf-8", errors="replace")
    found: dict[str, str] = {}
    for pattern in (_ATTRIBUTE, _ELEMENT):
        for match in pattern.finditer(text):
            prefix, name, *values = match.groups()
            value = next((each for each in values if each is not None), "").strip()
            if prefix != "xmlns" and len(found) < MAX_VALUES:
                found.setdefault(f"{prefix}:{name}", value)
    return found


def first_number(values: Mapping[str, str], *names: str) -> float | None:
    """The first of these values that is a finite number, such as "+39.80"."""
    for name in names:
        try:
            value = float(values[name])
        except (KeyError, ValueError):
            continue
        if abs(value) < 1e12:  # false for NaN too
            return value
    return None
