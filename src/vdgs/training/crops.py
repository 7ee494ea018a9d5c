"""The part of each photograph that shows a block, the only part that its training draws.

The coarse model is rendered with the block's anchors white and all others black: pixels that are not black show it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vdgs.errors import RunError, VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.renderer import render_scalar
from vdgs.system.atomic_files import read_json, write_json

#: Longest side in pixels at which the parts are looked for.
CROP_RENDER_SIDE_PX = 320
#: A pixel shows a block where the block's anchors have at least this share in it (choice).
MIN_CONTRIBUTION = 0.1
#: Share of a block's pixels that may lie outside each side of a crop, so that single pixels do not widen it (choice).
TAIL_FRACTION = 0.005
#: A crop is widened by this share of the photograph's longest side, on each side (choice), which also keeps the border
#: effects of SSIM's windows off the block.
MARGIN = 0.04
#: A part as large as this is the whole photograph: nothing would be saved.
FULL_AREA_FRACTION = 0.9
#: Every so many steps draw the whole photograph (choice): floaters outside the crops would otherwise remain. It is no
#: multiple of the steps between two that compare depths or draw a pseudo view: whole photographs meet these too.
FULL_IMAGE_EVERY = 5
#: Smaller parts make at most so many times more steps: a step costs something however little it draws (choice).
MAX_STEP_FACTOR = 4.0


#: Left, top, right, bottom of a part of a picture in pixels: [left, right).
PixelBox = tuple[int, int, int, int]


@dataclass(frozen=True)
class Crop:
    """A rectangle in a photograph, its sides as shares of the width and height."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def area(self) -> float:
        """Share of the photograph's pixels."""
        return (self.right - self.left) * (self.bottom - self.top)

    def pixels(self, width: int, height: int) -> PixelBox:
        """Where it is in a photograph of that size, at least one pixel wide and high."""
        left, top = (math.floor(share * size) for share, size in ((self.left, width), (self.top, height)))
        left, top = min(left, width - 1), min(top, height - 1)
        return left, top, max(math.ceil(self.right * width), left + 1), max(math.ceil(self.bottom * height), top + 1)


#: The whole photograph.
FULL_IMAGE = Crop(0.0, 0.0, 1.0, 1.0)


def compute_crops(model: AnchorModel, own: Bool[Tensor, " n"], cameras: Sequence[Camera]) -> tuple[Crop, ...]:
    """For each camera the part of its image that shows anchors `own` of the model; all of it where that is nearly all,
    or nothing (the block then lies behind the coarse model's surface)."""
    small = (camera.limit_size(CROP_RENDER_SIDE_PX) for camera in cameras)
    return tuple(_crop(render_scalar(model, own.float(), camera)[0].cpu().numpy()) for camera in small)


def _crop(share: Float[np.ndarray, "h w"]) -> Crop:
    shown = share >= MIN_CONTRIBUTION
    if not shown.any():
        return FULL_IMAGE
    height, width = shown.shape
    margin = MARGIN * max(width, height)
    left, right = _span(shown.sum(0), margin)
    top, bottom = _span(shown.sum(1), margin)
    crop = Crop(left, top, right, bottom)
    return FULL_IMAGE if crop.area >= FULL_AREA_FRACTION else crop


def _span(counts: Int[np.ndarray, " s"], margin: float) -> tuple[float, float]:
    """First and last place of a row of pixels, as shares of its length, between which all but `TAIL_FRACTION` on each
    side of the counts lie, widened by `margin` pixels."""
    reached = np.cumsum(counts) / counts.sum()
    first = int(np.searchsorted(reached, TAIL_FRACTION, side="right"))
    last = int(np.searchsorted(reached, 1 - TAIL_FRACTION)) + 1
    size = len(counts)
    return max(first - margin, 0) / size, min(last + margin, size) / size


def crop_at(crops: Sequence[Crop] | None, view: int, iteration: int) -> Crop:
    """The part of a view that iteration (from 0) draws."""
    return FULL_IMAGE if crops is None or (iteration + 1) % FULL_IMAGE_EVERY == 0 else crops[view]


def mean_crop_area(crops: Sequence[Crop], shares: Sequence[float] | None) -> float:
    """Share of a photograph that a step draws on average, photographs being used in proportion to `shares`."""
    part = float(np.average([crop.area for crop in crops], weights=shares))
    return part + (1.0 - part) / FULL_IMAGE_EVERY


def steps_for(num_images: int, area: float) -> int:
    """How many steps, of pictures that are this share of a photograph, draw as much as so many photographs."""
    return round(num_images * min(1.0 / area, MAX_STEP_FACTOR))


def load_or_compute_crops(path: Path, count: int, find: Callable[[], tuple[Crop, ...]]) -> tuple[Crop, ...]:
    """The crops of a file, or those found now and written to it: training that continues, perhaps on another machine
    or with another version, draws the same parts. Raises RunError for a file that does not hold `count` of them."""
    if not path.exists():
        crops = find()
        write_json(path, {"crops": [[*vars(crop).values()] for crop in crops]})
        return crops
    try:
        crops = tuple(Crop(*map(float, sides)) for sides in read_json(path)["crops"])
        if len(crops) != count or not all(0 <= c.left < c.right <= 1 and 0 <= c.top < c.bottom <= 1 for c in crops):
            raise ValueError(f"{count} parts of photographs were expected")
    except (KeyError, TypeError, ValueError, VdgsError) as error:
        raise RunError(f"{path}: is damaged ({error}). Delete it, and the parts are found again.") from error
    return crops
