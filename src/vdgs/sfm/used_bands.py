"""Which pictures of a multispectral set are used: the color photographs, or those of one band."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from vdgs.sfm.image_metadata import ImageMetadata
from vdgs.sfm.spectral_bands import BY_NUMBER, CLEARLY_NAMED, MICASENSE, shot_of

#: The band that shows the ground as eyes do, where there is no color: the first of these that is there.
_PREFERRED = ("panchro", "green", "red", "blue")
_THERMAL = re.compile("lwir|thermal", re.IGNORECASE)
#: Fewer color photographs with tags than this share of the exposures are none of the set.
_COLOR_SHARE = 0.5
#: Fewer pictures with the name of a band are none, unless more than the name says so (choice).
_LEAST_NAMED = 3
#: A band alone is one where so many of its pictures have a color photograph of their shot by their names (choice).
_SHARE_BESIDE = 0.5
#: Of a set, so many pictures of its index are made for each exposure at most (choice), which lose the tags.
_MADE_OF_IT = 2


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
    made = _may_be_made_of(color, [photo for photo in photographs if photo.name in band_of])
    enough = len(color) > _MADE_OF_IT * counts[used] if made else len(color) >= counts[used]
    if tagged >= _COLOR_SHARE * max(counts.values()) or enough:
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


def _may_be_made_of(color: Sequence[ImageMetadata], bands: Sequence[ImageMetadata]) -> bool:
    """Whether photographs without tags may be previews or maps of an index (NDVI) of the pictures of bands: these are
    sure and have tags, or are larger."""
    if 2 * sum(photo.is_bare for photo in color) <= len(color):
        return False
    kept = all(photo.band_is_sure and not photo.is_bare for photo in bands)
    return kept or median(math.prod(each.size) for each in color) < median(math.prod(each.size) for each in bands)


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
    """The pictures of bands. What its name alone says to be of one is so in a set of several bands, beside color
    photographs of the same shots, and where the name means nothing else."""
    counts = Counter(photo.band for photo in photographs if photo.band)
    sure = {photo.band for photo in photographs if photo.band and photo.band_is_sure}
    known = {band for band in counts if band in sure or counts[band] >= _LEAST_NAMED}
    if len(known) == 1 and not _is_clear(next(iter(known)), photographs):
        return [photo for photo in photographs if photo.band in known and photo.band_is_sure]
    return [photo for photo in photographs if photo.band in known]


def _is_clear(band: str, photographs: Sequence[ImageMetadata]) -> bool:
    """Whether the names of a band's pictures, or those of color photographs beside them, say that it is one."""
    if band in CLEARLY_NAMED:
        return True
    shots = {_shot_of(photo) for photo in photographs if not photo.band}
    beside = [_shot_of(photo) in shots for photo in photographs if photo.band == band]
    return sum(beside) >= _SHARE_BESIDE * len(beside)


def _shot_of(photo: ImageMetadata) -> tuple[Path, str]:
    return photo.path.parent, shot_of(photo.path)
