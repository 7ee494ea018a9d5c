"""XMP as it lies in files of photographs: in several packets, in parts, as text of a PNG, in UTF-16."""

from __future__ import annotations

import re
import struct
from contextlib import suppress

from PIL import Image

#: So much of XMP is looked at, of a packet and of all packets of a file; those of drones take a few kB.
MAX_XMP_BYTES = 1 << 18
#: Packets of a file, and parts of an extended one; more are not looked at.
_MAX_PACKETS, _MAX_PARTS = 8, 64
_STANDARD, _EXTENDED = b"http://ns.adobe.com/xap/1.0/\x00", b"http://ns.adobe.com/xmp/extension/\x00"
#: Behind the header of a part: 32 digits of the packet it is of, the length of that and where in it the part begins.
_GUID_BYTES, _PART_BYTES = 32, 40
_EXIF = b"Exif\x00\x00"
#: ImageMagick's profiles in the text of a PNG: name, number of bytes, and these in hexadecimal digits.
_PROFILE = re.compile(r"\s{0,8}[\w./ -]{1,40}\n\s{0,20}\d{1,10}\n([0-9A-Fa-f\s]*)")


def as_utf8(packet: bytes) -> bytes:
    """A packet in UTF-8, of which no more is taken than is looked at; XMP may be in UTF-16 and UTF-32 too."""
    head, packet = packet[:4], packet[: 4 * MAX_XMP_BYTES]
    if head in (b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff"):
        coding = "utf-32"
    elif head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        coding = "utf-16"
    elif head[:2] in (b"<\x00", b"\x00<"):
        coding = "utf-16-le" if head[0] else "utf-16-be"
    else:
        return packet[:MAX_XMP_BYTES]
    return packet.decode(coding, errors="replace").encode("utf-8", errors="replace")[:MAX_XMP_BYTES]


def xmp_of(image: Image.Image) -> bytes:
    """All packets of an open picture, the first first, in UTF-8; each has an equal share of what is looked at."""
    segments = [bytes(content) for marker, content in getattr(image, "applist", ()) if marker == "APP1"]
    packets = [each[len(_STANDARD) :] for each in segments if each.startswith(_STANDARD)]
    packets = packets or [_bytes_of(image.info.get("xmp", b""))]
    packets += [_profile(image, "xmp"), _profile(image, "APP1").partition(_STANDARD)[2]]
    packets += _extended([each[len(_EXTENDED) :] for each in segments if each.startswith(_EXTENDED)], packets)
    found = [as_utf8(each) for each in packets if each][:_MAX_PACKETS]
    return b"\n".join(each[: MAX_XMP_BYTES // len(found) - 1] for each in found)


def exif_of(image: Image.Image) -> Image.Exif:
    """EXIF of an open picture, also from the text of a PNG."""
    profile = _profile(image, "APP1")
    if profile.startswith(_EXIF) and "exif" not in image.info:
        exif = Image.Exif()
        with suppress(SyntaxError, struct.error):  # damaged: as without
            exif.load(profile)
            return exif
    return image.getexif()


def _extended(parts: list[bytes], packets: list[bytes]) -> list[bytes]:
    """What did not fit into one segment, put together; of packets that another one names, as others are left over."""
    named = b"".join(packets)
    wholes: dict[bytes, list[tuple[int, bytes]]] = {}
    for part in parts[:_MAX_PARTS]:
        guid, start = part[:_GUID_BYTES], int.from_bytes(part[_PART_BYTES - 4 : _PART_BYTES], "big")
        if len(part) > _PART_BYTES and guid in named:
            wholes.setdefault(guid, []).append((start, part[_PART_BYTES:]))
    return [b"".join(content for _, content in sorted(whole)) for whole in wholes.values()]


def _profile(image: Image.Image, name: str) -> bytes:
    """A profile that ImageMagick wrote into the text of a PNG before the pixels; empty for none, and for nonsense."""
    written = image.info.get(f"Raw profile type {name}")
    match = _PROFILE.match(written[: 8 * MAX_XMP_BYTES]) if isinstance(written, str) else None
    digits = "".join(match[1].split()) if match else ""
    try:
        return bytes.fromhex(digits[: len(digits) // 2 * 2])
    except ValueError:
        return b""


def _bytes_of(packet: object) -> bytes:
    return packet if isinstance(packet, bytes) else str(packet).encode("utf-8", errors="replace")
