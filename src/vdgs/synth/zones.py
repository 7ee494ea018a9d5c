"""Land use: a painted map of what covers the ground inside the town."""

from __future__ import annotations

from enum import IntEnum

import cv2
import numpy as np

#: What covers the ground. OPEN is farmland, painted by formula; streets are drawn over every zone.
LandUse = IntEnum(
    "LandUse",
    "OPEN LAWN PATH PATIO DRIVE SOIL SQUARE ASPHALT GRAVEL PITCH LINE FLOWERS "
    "MEADOW WOODS SAND WHEAT LAVENDER PLOUGHED GREENS BUILDING COURT",
    start=0,
)


class LandUseMap:
    """A square raster of zones around the origin of the world, [side, side] uint8, row by y.

    Its cells are as fine (m) as a map of tens of megabytes allows: lines of paint are 0.15 m wide.
    """

    def __init__(self, half_size: float) -> None:
        self.half_size = half_size
        self.cell = 0.05 if half_size < 180 else 0.1 if half_size < 450 else 0.15
        side = int(np.ceil(2 * half_size / self.cell))
        self.cells = np.zeros((side, side), np.uint8)

    def paint(self, ring: np.ndarray, zone: LandUse) -> None:
        """Fill a world polygon [k, 2] (metres)."""
        cv2.fillPoly(self.cells, [self._fixed_point(ring)], int(zone), lineType=cv2.LINE_8, shift=4)

    def stroke(self, points: np.ndarray, width: float, zone: LandUse, closed: bool = False) -> None:
        """Draw a world polyline [k, 2] of a width in metres."""
        thickness = max(1, round(width / self.cell))
        cv2.polylines(self.cells, [self._fixed_point(points)], closed, int(zone), thickness, cv2.LINE_8, shift=4)

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The zone at world places, [n] uint8; OPEN off the map."""
        side = self.cells.shape[0]
        column = ((x + self.half_size) * np.float32(1 / self.cell)).astype(np.int32)
        row = ((y + self.half_size) * np.float32(1 / self.cell)).astype(np.int32)
        outside = (np.abs(x) >= self.half_size - self.cell) | (np.abs(y) >= self.half_size - self.cell)
        column, row = np.clip(column, 0, side - 1), np.clip(row, 0, side - 1)
        return np.where(outside, np.uint8(LandUse.OPEN), self.cells[row, column])

    def _fixed_point(self, points: np.ndarray) -> np.ndarray:
        # cv2 takes sixteenths of a cell and puts cell centers at whole numbers
        return np.round(((np.asarray(points) + self.half_size) / self.cell - 0.5) * 16).astype(np.int32)
