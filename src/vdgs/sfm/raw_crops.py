"""The crop that Lightroom and Camera Raw say: the tags of the lens stay those of the whole picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

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
    edges = _edges(xmp)
    if edges is None:
        return None, ""
    said = text(xmp, "crs:AlreadyApplied").lower() == "true"
    longer, aspect = max(width, height), max(width, height) / min(width, height)
    angle = math.radians(first_number(xmp, "crs:CropAngle") or 0.0)
    found = _explained(edges.across, edges.down, angle, aspect)
    if whole and _alike(longer, whole) and (found is None or not _alike(found.part, 1.0)):
        return None, ""
    if found is None:
        return None, _unexplained(edges, width, height) if said else ""
    cut = whole is not None and _alike(longer, found.part * whole)
    odd = not any(_alike(aspect, shape) for shape in USUAL_SHAPES)
    return (replace(found, beside=edges.off_middle(found.shape) / found.part) if cut or odd or said else None), ""


class _Edges(NamedTuple):
    """Edges of a crop as shares of the sides of the whole."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def across(self) -> float:
        return self.right - self.left

    @property
    def down(self) -> float:
        return self.bottom - self.top

    def off_middle(self, shape: float) -> float:
        """How far the middle is from that of a whole of some shape, over its longer side."""
        return math.hypot((self.left + self.right) / 2 - 0.5, ((self.top + self.bottom) / 2 - 0.5) / shape)


def _edges(xmp: Mapping[str, str]) -> _Edges | None:
    """The crop that XMP says; None where it says none, or one of all or of nothing."""
    found = [first_number(xmp, f"crs:Crop{side}") for side in ("Left", "Right", "Top", "Bottom")]
    if text(xmp, "crs:HasCrop").lower() != "true" or None in found:
        return None
    edges = _Edges(*(edge or 0.0 for edge in found))
    is_part = 0 < edges.across <= 1 and 0 < edges.down <= 1 and edges.across * edges.down != 1
    return edges if is_part else None


def _unexplained(edges: _Edges, width: int, height: int) -> str:
    return (
        f"cropped by a program, but not as XMP says (crs:HasCrop: {edges.across:.0%} of the width, {edges.down:.0%} of "
        f"the height give no {width} x {height} px of a usual shape); the focal length may be that of the whole"
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
