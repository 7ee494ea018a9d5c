"""Which pictures of a multispectral set are used: the color photographs, or those of one band."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence

from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.spectral_bands import BY_NUMBER, MICASENSE

#: The band that shows the ground as eyes do, where there is no color: the first of these that is there.
_PREFERRED = ("panchro", "green", "red", "blue")
_THERMAL = re.compile("lwir|thermal", re.IGNORECASE)
#: Fewer color photographs with tags than this share of the exposures are none of the set.
_COLOR_SHARE = 0.5
#: Fewer pictures with the name of a band are none, unless more than the name says so (choice).
_LEAST_NAMED = 3


def unused_bands(photographs: Sequence[ImageMetadata]) -> tuple[dict[str, str], list[str]]:
    """The pictures of bands that are not used, with the reason, and what people should know of the set."""
    band_of = _by_size(photographs)
    counts = Counter(band_of.values())
    if not counts:
        return {}, []
    bands = ", ".join(f"{band} ({number})" for band, number in sorted(counts.items()))
    used = min(counts, key=lambda band: (_rank(band), -counts[band], band))
    color = [photo for photo in photographs if photo.name not in band_of]
    tagged = sum(not photo.is_bare for photo in color)
    if tagged >= _COLOR_SHARE * max(counts.values()) or len(color) >= counts[used]:
        used, how = "", f"the {len(color)} color photographs beside them are used"
    else:
        how = f"{used} is used, in gray, without calibration of reflectance"
    left = {
        name: f"is of the band {band}; a folder of one band alone can be used"
        for name, band in band_of.items()
        if band != used
    }
    if used:  # in one scene, gray and color would make a mixture of both
        left |= {
            photo.name: f"is none of the band {used}, which is used; a folder of color photographs alone can be used"
            for photo in color
        }
    return left, [f"pictures of single bands: {bands}; {how}."]


def _rank(band: str) -> int:
    alike = [k for k, name in enumerate(_PREFERRED) if band.lower().replace("_", " ").split(" ")[0].startswith(name)]
    edge = "edge" in band.lower()
    return alike[0] if alike and not edge else len(_PREFERRED) + edge + 2 * bool(_THERMAL.search(band))


def _by_size(photographs: Sequence[ImageMetadata]) -> dict[str, str]:
    """The band of each picture that is of one, by its name. A band known by its number alone is panchromatic where its
    pictures are larger than those of the others, and thermal where they are smaller (MicaSense's Altum, Altum-PT and
    RedEdge-P)."""
    photographs = _of_bands(photographs)
    bands = {photo.name: photo.band for photo in photographs}
    usual = Counter(photo.size for photo in photographs if photo.band in MICASENSE).most_common(1)
    for photo in photographs if usual else ():
        if photo.band.startswith(BY_NUMBER) and photo.size != usual[0][0]:
            larger = photo.width * photo.height > math.prod(usual[0][0])
            bands[photo.name] = "Panchro" if larger else "LWIR"
    return bands


def _of_bands(photographs: Sequence[ImageMetadata]) -> list[ImageMetadata]:
    """The pictures of bands: what its name alone says to be of one is so in a set of several bands."""
    counts = Counter(photo.band for photo in photographs if photo.band)
    sure = {photo.band for photo in photographs if photo.band and photo.band_is_sure}
    known = {band for band in counts if band in sure or counts[band] >= _LEAST_NAMED}
    return [photo for photo in photographs if photo.band in known and (photo.band_is_sure or len(known) > 1)]
