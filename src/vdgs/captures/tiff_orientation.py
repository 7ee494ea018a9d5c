"""TIFFs as their files have them: decoders turn those upright whose tag says that they lie, unlike all other files."""

from __future__ import annotations

import struct

import numpy as np
from PIL import Image

_ORIENTATION, _WIDTH, _HEIGHT = 0x0112, 0x0100, 0x0101
#: By the first four bytes: order of bytes; where the place of a directory stands and its format, which is that of the
#: number of values of an entry too; the format of the number of entries, and the bytes of one.
_HEADS = {
    b"II*\0": ("<", 4, "I", "H", 12), b"MM\0*": (">", 4, "I", "H", 12),
    b"II+\0": ("<", 8, "Q", "Q", 20), b"MM\0+": (">", 8, "Q", "Q", 20),
}  # fmt: skip
#: TIFF's type of whole numbers of 16 bits.
_SHORT = 3


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Width and height of the pixels as a file that was opened has them; of TIFFs Pillow tells those once upright."""
    if image.format != "TIFF":
        return image.size
    tags = image.tag_v2  # type: ignore[attr-defined]
    return int(tags[_WIDTH]), int(tags[_HEIGHT])


def without_orientation(data: np.ndarray) -> np.ndarray:
    """The bytes [n] uint8 of a picture; of a TIFF, with a tag that says that it is upright as it is.

    The whole entry is written: the value of one may stand elsewhere, if it is of 8 bytes or of several numbers.
    """
    head = _HEADS.get(data[:4].tobytes())
    if head is None:
        return data
    order, start, place, count, entry = head
    try:
        (at,) = struct.unpack_from(order + place, data.data, start)
        (entries,) = struct.unpack_from(order + count, data.data, at)
        first = at + struct.calcsize(count)
        for where in range(first, first + entry * min(entries, len(data) // entry), entry):
            if struct.unpack_from(order + "H", data.data, where) == (_ORIENTATION,):
                upright = data.copy()
                struct.pack_into(f"{order}HH{place}H", upright.data, where, _ORIENTATION, _SHORT, 1, 1)
                return upright
    except struct.error:  # a damaged file, of which decoders tell
        pass
    return data
