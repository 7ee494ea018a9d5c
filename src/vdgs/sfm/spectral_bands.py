"""Sets of multispectral cameras: the color photographs are used where there are any, else the pictures of one band."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import TYPE_CHECKING

from vdgs.sfm.xmp import text

if TYPE_CHECKING:
    from vdgs.sfm.image_metadata import ImageMetadata

#: What makers put behind the name of a picture of one band (DJI Mavic 3M; Parrot Sequoia), and the names of bands.
_TAILS = re.compile(r".+_(?:MS_(?P<dji>G|R|RE|NIR)|(?P<sequoia>GRE|RED|REG|NIR))", re.IGNORECASE)
_BANDS = {"G": "Green", "R": "Red", "RE": "Red edge", "NIR": "NIR", "GRE": "Green", "RED": "Red", "REG": "Red edge"}
#: MicaSense: IMG_0001_1.tif to IMG_0001_6.tif.
_NUMBERED = re.compile(r"IMG_\d{4,}_(?P<number>\d{1,2})", re.IGNORECASE)
_MICASENSE = ("Blue", "Green", "Red", "NIR", "Red edge", "Panchro")
#: The band that shows the ground as eyes do, where there is no color: the first of these that is there.
_PREFERRED = ("panchro", "green", "red", "blue")
#: Fewer color photographs than this share of the exposures are none of the set.
_COLOR_SHARE = 0.5


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


def unused_bands(photographs: Sequence[ImageMetadata]) -> tuple[dict[str, str], list[str]]:
    """The pictures of bands that are not used, with the reason, and what people should know of the set."""
    counts = Counter(photo.band for photo in photographs if photo.band)
    if not counts:
        return {}, []
    bands = ", ".join(f"{band} ({number})" for band, number in sorted(counts.items()))
    color = sum(not photo.band and photo.lens is not None for photo in photographs)
    if color >= _COLOR_SHARE * max(counts.values()):
        used, how = "", f"the {color} color photographs beside them are used"
    else:
        used = min(counts, key=lambda band: (_rank(band), -counts[band], band))
        how = f"{used} is used, in gray, without calibration of reflectance"
    left = {
        photo.name: f"is of the band {photo.band}; a folder of one band alone can be used"
        for photo in photographs
        if photo.band and photo.band != used
    }
    return left, [f"pictures of single bands: {bands}; {how}."]


def _rank(band: str) -> int:
    alike = [k for k, name in enumerate(_PREFERRED) if band.lower().replace("_", " ").split(" ")[0].startswith(name)]
    edge = "edge" in band.lower()
    return alike[0] if alike and not edge else len(_PREFERRED) + edge
