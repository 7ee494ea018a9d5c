"""The crop that Lightroom and Camera Raw say: the tags of the lens stay those of the whole picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from vdgs.sfm.xmp import first_number, text

#: Shapes that cameras take: longer side over shorter.
USUAL_SHAPES = (16 / 9, 3 / 2, 4 / 3, 1.0)
#: Sides and shapes that differ by less than this share are one: 4608 x 3456, 5280 x 3956 and 4000 x 3000 are 4:3.
SAME_SHARE = 0.01


@dataclass(frozen=True)
class RawCrop:
    """A part of a picture that a program exported."""

    part: float
    """Its longer side over that of the whole."""
    shape: float
    """Longer side of the whole over its shorter."""
    beside: float = 0.0
    """How far its middle is from that of the whole, over its longer side."""


def read_raw_crop(xmp: Mapping[str, str], width: int, height: int, whole: float | None) -> tuple[RawCrop | None, str]:
    """The crop that made a picture of its whole, whose longer side had `whole` pixels, as far as that is known; and
    what is unclear.

    XMP also keeps crops that nobody applied (in raw files, and in JPEGs that were only developed): of these the pixels
    are whole. Sizes tell it, then the shape, then what the program says (crs:AlreadyApplied).
    """
    edges = [first_number(xmp, f"crs:Crop{side}") for side in ("Left", "Right", "Top", "Bottom")]
    left, right, top, bottom = (edge or 0.0 for edge in edges)
    if text(xmp, "crs:HasCrop").lower() != "true" or None in edges:
        return None, ""
    across, down = right - left, bottom - top
    if not (0 < across <= 1 and 0 < down <= 1) or across * down == 1:
        return None, ""
    said = text(xmp, "crs:AlreadyApplied").lower() == "true"
    longer, aspect = max(width, height), max(width, height) / min(width, height)
    found = _explained(across, down, math.radians(first_number(xmp, "crs:CropAngle") or 0.0), aspect)
    if whole and _alike(longer, whole) and (found is None or not _alike(found.part, 1.0)):
        return None, ""
    if found is not None:
        cut = whole is not None and _alike(longer, found.part * whole)
        odd = not any(_alike(aspect, shape) for shape in USUAL_SHAPES)
        off = math.hypot((left + right) / 2 - 0.5, ((top + bottom) / 2 - 0.5) / found.shape)
        return (replace(found, beside=off / found.part) if cut or odd or said else None), ""
    return None, (
        f"cropped by a program, but not as XMP says (crs:HasCrop: {across:.0%} of the width, {down:.0%} of the height "
        f"give no {width} x {height} px of a usual shape); the focal length may be that of the whole"
        if said
        else ""
    )


def _explained(across: float, down: float, angle: float, aspect: float) -> RawCrop | None:
    """The crop of a picture of a usual shape that has this aspect: its edges are shares of the sides of the whole, and
    join two opposite corners of a rectangle that is turned by an angle, to either side."""
    for shape in USUAL_SHAPES:
        for turn in (angle, -angle):
            wide = abs(across * math.cos(turn) + down / shape * math.sin(turn))
            high = abs(down / shape * math.cos(turn) - across * math.sin(turn))
            if min(wide, high) > 0 and _alike(max(wide, high) / min(wide, high), aspect):
                return RawCrop(max(wide, high), shape)
    return None


def _alike(one: float, other: float) -> bool:
    return abs(one / other - 1) < SAME_SHARE
