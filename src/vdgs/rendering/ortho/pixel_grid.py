"""The pixels of a map: where they lie, how large they are, how they are cut into tiles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vdgs.captures.capture import Capture
from vdgs.captures.scene_points import MIN_SEEN_BY, scene_points
from vdgs.captures.scene_points import ground_sampling_distance as scene_gsd
from vdgs.errors import VdgsError
from vdgs.geometry.map_projection import MapProjection

#: Side of a tile in pixels: that of the blocks of the files, so that a tile is written as one.
TILE_PX = 512
#: A map ends beyond the points of the scene, but for a share of them on every side, by a share of its size (choice).
_TRIM_QUANTILE, _MARGIN_SHARE = 0.002, 0.03
#: From fewer points nothing is said of where the scene ends (choice).
_MIN_POINTS = 10
#: No map has more pixels: a hundred thousand each way.
MAX_PIXELS = 10_000_000_000


@dataclass(frozen=True)
class PixelGrid:
    """Pixels of `gsd` target units from the upper left corner (`left`, `top`): x to the right, y up."""

    left: float
    top: float
    gsd: float
    width: int
    height: int

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in target coordinates."""
        return (self.left, self.top - self.gsd * self.height, self.left + self.gsd * self.width, self.top)

    @property
    def center(self) -> tuple[float, float]:
        x0, y0, x1, y1 = self.bounds
        return ((x0 + x1) / 2, (y0 + y1) / 2)

    def subgrid(self, column: int, row: int, width: int, height: int) -> PixelGrid:
        """The pixels from `column` and `row` on."""
        return PixelGrid(self.left + column * self.gsd, self.top - row * self.gsd, self.gsd, width, height)

    def tiles(self, side: int = TILE_PX) -> Iterator[tuple[int, int, PixelGrid]]:
        """Column, row and pixels of every tile, row by row; the last ones are smaller."""
        return (self.tile(number, side) for number in range(self.tile_count(side)))

    def tile(self, number: int, side: int = TILE_PX) -> tuple[int, int, PixelGrid]:
        """The tile of this number among `tiles`, from 0."""
        row, column = (side * index for index in divmod(number, -(-self.width // side)))
        size = min(side, self.width - column), min(side, self.height - row)
        return column, row, self.subgrid(column, row, *size)

    def tile_count(self, side: int = TILE_PX) -> int:
        return -(-self.width // side) * -(-self.height // side)


def grid_of_map(
    capture: Capture,
    extent: tuple[float, float, float, float] | None,
    finest: float | None,
    bbox: tuple[float, float, float, float] | None,
    gsd: float | None,
) -> PixelGrid:
    """The grid of the box and pixel size that are asked for, in their place of what the photographs show (`extent`)
    and the size of their pixels (`finest`). Raises VdgsError where neither is known, and as `grid_from_bbox`."""
    box, size = bbox or extent, finest if gsd is None else gsd
    if size is None:
        raise VdgsError(f"{capture.root}: no photograph holds a sparse point to measure its pixels by. Give --gsd.")
    if box is None:
        raise VdgsError(
            f"{capture.root}: has fewer than {_MIN_POINTS} sparse points in {MIN_SEEN_BY} pictures or more, too few to "
            "tell what a map should show. Give --bbox X0 Y0 X1 Y1."
        )
    return grid_from_bbox(box, size)


def grid_from_bbox(bbox: tuple[float, float, float, float], gsd: float) -> PixelGrid:
    """The grid that covers x0, y0, x1, y1, its lines at multiples of `gsd`: maps of one scene lie on each other.

    Raises VdgsError for a size or a box that makes no map, and for one of more than `MAX_PIXELS`.
    """
    x0, y0, x1, y1 = bbox
    if not (math.isfinite(gsd) and gsd > 0):
        raise VdgsError(f"--gsd {gsd}: a pixel needs a size above 0.")
    if not (all(map(math.isfinite, bbox)) and x0 < x1 and y0 < y1):
        raise VdgsError(f"--bbox {' '.join(f'{v:.12g}' for v in bbox)}: must be X0 Y0 X1 Y1 with X0 < X1 and Y0 < Y1.")
    # A box that ends on a line, but for rounding, ends there.
    left, bottom = math.floor(x0 / gsd + 1e-6), math.floor(y0 / gsd + 1e-6)
    right, top = math.ceil(x1 / gsd - 1e-6), math.ceil(y1 / gsd - 1e-6)
    width, height = max(right - left, 1), max(top - bottom, 1)
    if width * height > MAX_PIXELS:
        coarser = gsd * math.sqrt(width * height / MAX_PIXELS)
        raise VdgsError(
            f"--gsd {gsd:g}: the map would have {width} x {height} pixels, more than {MAX_PIXELS:.0e}. Give --gsd "
            f"{_rounded_up(coarser):g} or larger, or a smaller --bbox."
        )
    return PixelGrid(left * gsd, top * gsd, gsd, width, height)


def capture_extent(capture: Capture, placement: MapProjection) -> tuple[float, float, float, float] | None:
    """x0, y0, x1, y1 in target coordinates of what the training photographs show, by the sparse points; None where
    there are too few to tell."""
    shown = scene_points(capture)
    if len(shown) < _MIN_POINTS:
        return None
    low, high = np.quantile(placement.project(shown)[:, :2], [_TRIM_QUANTILE, 1 - _TRIM_QUANTILE], axis=0)
    beyond = _MARGIN_SHARE * (high - low)
    return (*(low - beyond).tolist(), *(high + beyond).tolist())


def check_overlap(
    bbox: tuple[float, float, float, float], extent: tuple[float, float, float, float], placement: MapProjection
) -> None:
    """Raise VdgsError where a box lies wholly beside what the photographs show, by more than that is wide."""
    x0, y0, x1, y1 = extent
    left, bottom, right, top = bbox
    width, height = x1 - x0, y1 - y0
    if left > x1 + width or right < x0 - width or bottom > y1 + height or top < y0 - height:
        in_degrees = max(map(abs, (left, right))) <= 180 and max(map(abs, (bottom, top))) <= 90 and abs(y0) > 90
        raise VdgsError(
            f"--bbox {' '.join(f'{v:.12g}' for v in bbox)}: lies beside the scene, which spans "
            f"{' '.join(f'{v:.1f}' for v in extent)} in {placement.name}."
            + (" Longitudes and latitudes? Give the box in that system." if in_degrees else "")
        )


def ground_sampling_distance(capture: Capture, scale: float) -> float | None:
    """The median size of a pixel of the training photographs on what they show, in target units, to two digits.

    `scale`: target units in one of the ground frame. None where no photograph holds a sparse point.
    """
    size = scene_gsd(capture)
    return None if size is None else float(f"{scale * size:.2g}")


def ground_height(capture: Capture) -> float:
    """The median height of the sparse points in the ground frame; 0 without any."""
    return float(np.median(capture.points[:, 2])) if len(capture.points) else 0.0


def median_point(capture: Capture) -> Float[np.ndarray, "3"]:
    """The median sparse point [3]."""
    return np.median(capture.points, axis=0) if len(capture.points) else np.zeros(3)


def _rounded_up(value: float) -> float:
    step = 10.0 ** math.floor(math.log10(value) - 1)
    return math.ceil(value / step) * step
