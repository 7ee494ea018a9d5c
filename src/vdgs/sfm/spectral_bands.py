"""The bands of multispectral cameras, by the tags and the names of their pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePosixPath

from vdgs.sfm.xmp import text

#: What makers put behind the name of a picture of one band (DJI Mavic 3M; Parrot Sequoia), and the names of bands.
_TAILS = re.compile(r".+_(?:MS_(?P<dji>G|R|RE|NIR)|(?P<sequoia>GRE|RED|REG|NIR))", re.IGNORECASE)
_BANDS = {"G": "Green", "R": "Red", "RE": "Red edge", "NIR": "NIR", "GRE": "Green", "RED": "Red", "REG": "Red edge"}
#: MicaSense: IMG_0001_1.tif to IMG_0001_6.tif.
_NUMBERED = re.compile(r"IMG_\d{4,}_(?P<number>\d{1,2})", re.IGNORECASE)
_MICASENSE = ("Blue", "Green", "Red", "NIR", "Red edge", "Panchro")


def band_of(name: str, mode: str, xmp: Mapping[str, str]) -> str:
    """The band that a gray picture is of, by its XMP, else by its name; empty for color photographs and others."""
    if mode not in ("L", "I;16", "I;16B", "I;16L"):
        return ""
    said = text(xmp, "BandName")
    if said:
        return said
    stem = PurePosixPath(name).stem
    if tail := _TAILS.fullmatch(stem):
        return _BANDS[(tail["dji"] or tail["sequoia"]).upper()]
    numbered = _NUMBERED.fullmatch(stem)
    number = int(numbered["number"]) if numbered else 0
    return _MICASENSE[number - 1] if 1 <= number <= len(_MICASENSE) else f"band {number}" if number else ""
