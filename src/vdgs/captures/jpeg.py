"""Whether JPEGs are whole: cards and copies cut them off, and some cameras leave out the end marker alone."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from vdgs.captures.pillow_limits import pillow_without_limits

#: Pillow's names for JPEGs: MPO holds several pictures, a photograph and its preview (current drones, phones).
JPEGS = {"JPEG", "MPO"}
#: The end marker is looked for in so many bytes before the end, where only trailing data of makers may follow it.
_TAIL = 1 << 16
_END = b"\xff\xd9"
#: Bytes that a decoder goes on with where a file ends too early: different pictures come of them.
_FILLINGS = (b"\x00" * 4096, b"\x55\xaa\x33\x66" * 1024)
#: So many zeros at an end are no pixels.
_ZEROS = bytes(16)
_START_OF_SCAN, _WITHOUT_LENGTH = 0xDA, {0x01, *range(0xD0, 0xD9)}


def has_end(path: Path, image: Image.Image) -> bool:
    """Whether the photograph in a JPEG, the first picture of several, ends with its marker."""
    size = path.stat().st_size
    end = _first_picture(image) or size
    if end > size:
        return False
    with path.open("rb") as file:
        file.seek(max(_scan_at(path), end - _TAIL))
        return _END in file.read(max(0, end - file.tell()))


def lacks_only_end(path: Path) -> bool:
    """Whether a JPEG without an end has all its pixels: what would follow then changes none of them. False for files
    that Pillow cannot decode as a JPEG."""
    data = _without_half(path.read_bytes())
    try:
        one, other = (_pixels(data + filling + _END) for filling in _FILLINGS)
    except (OSError, SyntaxError, ValueError):
        return False
    return np.array_equal(one, other)


def with_end(path: Path) -> io.BytesIO:
    """The file with the end marker that it lacks."""
    return io.BytesIO(_without_half(path.read_bytes()) + _END)


def _without_half(data: bytes) -> bytes:
    """A file without the first byte of a marker whose second is missing, and without the zeros that a rescued file may
    be filled up with: they would be decoded as pixels."""
    return (data.rstrip(b"\x00") if data.endswith(_ZEROS) else data).rstrip(_END[:1])


def _pixels(data: bytes) -> np.ndarray:
    with pillow_without_limits(), Image.open(io.BytesIO(data), formats=["JPEG"]) as image:
        return np.asarray(image)


def _first_picture(image: Image.Image) -> int:
    """Bytes of the first picture by the index of an MPO; 0 where there is none."""
    try:
        return int(image.mpinfo[0xB002][0]["Size"])  # type: ignore[attr-defined]
    except (AttributeError, KeyError, IndexError, TypeError, ValueError):
        return 0


def _scan_at(path: Path) -> int:
    """Where the pixels of a JPEG begin, behind its tags and the preview in them; 0 where that is not found."""
    with path.open("rb") as file:
        file.seek(2)
        while True:
            head = file.read(2)
            if len(head) < 2 or head[0] != 0xFF:
                return 0
            if head[1] == 0xFF:  # padding
                file.seek(-1, 1)
            elif head[1] == _START_OF_SCAN:
                return file.tell()
            elif head[1] not in _WITHOUT_LENGTH:
                length = int.from_bytes(file.read(2), "big")
                if length < 2:
                    return 0
                file.seek(length - 2, 1)
