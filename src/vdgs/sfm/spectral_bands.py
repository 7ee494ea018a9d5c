"""The bands of multispectral cameras, by the tags and the names of their pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from vdgs.captures.image_files import open_image
from vdgs.errors import CaptureError
from vdgs.sfm.xmp import text

#: What makers put behind the name of a picture of one band (DJI Mavic 3M; Parrot Sequoia), and the names of bands.
_TAILS = re.compile(r".+_(?:MS_(?P<dji>G|R|RE|NIR)|(?P<sequoia>GRE|RED|REG|NIR))", re.IGNORECASE)
_BANDS = {"G": "Green", "R": "Red", "RE": "Red edge", "NIR": "NIR", "GRE": "Green", "RED": "Red", "REG": "Red edge"}
#: MicaSense: IMG_0001_1.tif to IMG_0001_5.tif; what lies behind these differs from model to model.
_NUMBERED = re.compile(r"IMG_\d{4,}_(?P<number>\d{1,2})", re.IGNORECASE)
BY_NUMBER = "band "
#: Pillow's modes of gray; of gray stored as color, channels differ by no more, at this size.
_GRAYS = ("L", "I;16", "I;16B", "I;16L")
_GRAY, _LOOKED_AT = 4, (128, 128)
MICASENSE = ("Blue", "Green", "Red", "NIR", "Red edge")


def band_of(path: Path, mode: str, xmp: Mapping[str, str]) -> str:
    """The band that a gray picture is of, by its XMP, else by its name; empty for color photographs and others. Gray
    may be stored as color: where the rest speaks for a band, the pixels are looked at."""
    stem = path.stem
    tail = _TAILS.fullmatch(stem)
    said = text(xmp, "BandName") or (_BANDS[(tail["dji"] or tail["sequoia"]).upper()] if tail else "")
    if said or mode not in _GRAYS:
        return said if said and (mode in _GRAYS or _shows_gray(path)) else ""
    numbered = _NUMBERED.fullmatch(stem)
    number = int(numbered["number"]) if numbered else 0
    return MICASENSE[number - 1] if 1 <= number <= len(MICASENSE) else f"{BY_NUMBER}{number}" if number else ""


def _shows_gray(path: Path) -> bool:
    """Whether a picture that is stored in color shows gray alone, by some of its pixels."""
    try:
        with open_image(path) as image:
            image.draft("RGB", _LOOKED_AT)
            colors = np.asarray(image.convert("RGB").resize(_LOOKED_AT, Image.Resampling.NEAREST)).astype(int)
    except (CaptureError, OSError, SyntaxError, ValueError):
        return False
    return bool(np.ptp(colors, axis=2).max() <= _GRAY)
