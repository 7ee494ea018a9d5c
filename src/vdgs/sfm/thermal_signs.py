"""What makers of thermal cameras say in their pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping

from vdgs.captures.image_tags import ImageTags
from vdgs.sfm.exif_gps import plain_text
from vdgs.sfm.xmp import text

#: XMP's ImageSource (DJI) and BandName (Pix4D's names: FLIR, MicaSense, senseFly) of thermal pictures.
_WORDS = re.compile(r"infra-?red|thermal|lwir|\bt?ir\b", re.IGNORECASE)
#: EXIF's models of cameras that take nothing else: DJI's Zenmuse XT, FLIR's Vue and Tau, senseFly's thermoMAP.
#: Those of two sensors with one name for both are none.
_MODELS = re.compile(r"(zenmuse )?xt( ?r)?|(flir )?(vue( pro)?( r)?|tau ?2?)( \d+.*)?|thermomap.*", re.IGNORECASE)


def thermal_sign(found: ImageTags, xmp: Mapping[str, str]) -> str:
    """What says for certain that a picture is one of a thermal camera; empty where nothing does."""
    for name in ("ImageSource", "BandName"):
        said = text(xmp, name)
        if _WORDS.search(said) and "near" not in said.lower():
            return f"{name} {said} in XMP"
    model = plain_text(found.tags.get(0x0110))
    if _MODELS.fullmatch(model):
        return f"taken by {model}"
    return "temperatures in its file" if found.has_temperatures else ""
