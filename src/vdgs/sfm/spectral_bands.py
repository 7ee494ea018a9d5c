"""The bands of multispectral cameras, by the tags and the names of their pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from vdgs.sfm.picture_colors import GRAYS, shows_gray
from vdgs.sfm.xmp import text

#: What makers put behind the name of a picture of one band (DJI Mavic 3M; Parrot Sequoia), and the names of bands.
_TAILS = re.compile(r"(?P<shot>.+?)_(?:MS_(?P<dji>G|R|RE|NIR)|(?P<sequoia>GRE|RED|REG|NIR))", re.IGNORECASE)
_BANDS = {"G": "Green", "R": "Red", "RE": "Red edge", "NIR": "NIR", "GRE": "Green", "RED": "Red", "REG": "Red edge"}
#: MicaSense: IMG_0001_1.tif to IMG_0001_5.tif; what lies behind these differs from model to model.
_NUMBERED = re.compile(r"IMG_\d{4,}_(?P<number>\d{1,2})", re.IGNORECASE)
BY_NUMBER = "band "
#: Bands whose words in names mean nothing else.
CLEARLY_NAMED = ("NIR", "Red edge")
MICASENSE = ("Blue", "Green", "Red", "NIR", "Red edge")


def is_surely_of_band(path: Path, xmp: Mapping[str, str]) -> bool:
    """Whether more than a name that others use, too (`shed_red`, `IMG_0001_2`), speaks for a band."""
    tail = _TAILS.fullmatch(path.stem)
    return bool(text(xmp, "BandName") or (tail and tail["dji"]))


def shot_of(path: Path) -> str:
    """The name of a picture without what tells the one of a shot: IMG_0001_NIR, IMG_0001_RGB, IMG_0001_2, IMG_0001."""
    stem = path.stem.upper()
    if _NUMBERED.fullmatch(stem):
        return stem.rpartition("_")[0]
    tail = _TAILS.fullmatch(stem)
    return tail["shot"] if tail else stem.removesuffix("_RGB")


def band_of(path: Path, mode: str, xmp: Mapping[str, str]) -> str:
    """The band that a gray picture is of, by its XMP, else by its name; empty for color photographs and others. Gray
    may be stored as color: where the rest speaks for a band, the pixels are looked at."""
    stem = path.stem
    tail = _TAILS.fullmatch(stem)
    said = text(xmp, "BandName") or (_BANDS[(tail["dji"] or tail["sequoia"]).upper()] if tail else "")
    if said or mode not in GRAYS:
        return said if said and (mode in GRAYS or shows_gray(path)) else ""
    numbered = _NUMBERED.fullmatch(stem)
    number = int(numbered["number"]) if numbered else 0
    return MICASENSE[number - 1] if 1 <= number <= len(MICASENSE) else f"{BY_NUMBER}{number}" if number else ""
