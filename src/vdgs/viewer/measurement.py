"""Distances, heights and areas between clicked points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


class Ruler:
    """Measures between points in the order in which they were clicked, ground frame."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._points: list[np.ndarray] = []

    def add(self, point: Float[np.ndarray, "3"]) -> None:
        self._points.append(np.asarray(point, np.float64))

    def clear(self) -> None:
        self._points = []

    def points(self) -> Float[np.ndarray, "n 3"]:
        return np.array(self._points, np.float64).reshape(-1, 3)

    def distance(self) -> float:
        """Length of the polyline in space."""
        return float(np.linalg.norm(np.diff(self.points(), axis=0), axis=1).sum())

    def height_difference(self) -> float:
        """From the first point up to the last."""
        return float(self._points[-1][2] - self._points[0][2]) if self._points else 0.0

    def area(self) -> float:
        """Of the polygon of the points on the map (level), closed from the last to the first."""
        x, y = self.points()[:, :2].T
        return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))

    def to_markdown(self) -> str:
        """The measures, in Markdown."""
        if not self._points:
            return ""
        if len(self._points) == 1:
            return "Click the next place."
        level = float(np.linalg.norm(np.diff(self.points()[:, :2], axis=0), axis=1).sum())
        lines = [
            f"distance **{self.distance():,.2f} {self._unit}** ({level:,.2f} level)",
            f"height difference **{self.height_difference():+,.2f} {self._unit}**, first to last",
        ]
        if len(self._points) > 2:
            lines.append(f"area **{self.area():,.2f} {self._unit}²** on the map")
        return "\n\n".join(lines)
