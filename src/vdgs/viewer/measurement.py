"""Distances, heights and areas between clicked points, and known distances that give the scene its metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

#: The name of the file that holds known distances.
SCALE_BAR_FILE = "known-distances.txt"


@dataclass(frozen=True, eq=False)
class MeasuredPoint:
    """A clicked point, ground frame."""

    position: Float[np.ndarray, "3"]
    #: Standard deviation, in units of the ground frame.
    deviation: float = 0.0
    #: Photographs that show it, each with x/z and y/z of the camera's ray to it.
    rays: tuple[tuple[str, float, float], ...] = ()


class Ruler:
    """Measures between points in the order in which they were clicked."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self.clicked: list[MeasuredPoint] = []

    def add(self, point: MeasuredPoint) -> None:
        self.clicked.append(point)

    def clear(self) -> None:
        self.clicked = []

    def points(self) -> Float[np.ndarray, "n 3"]:
        return np.array([each.position for each in self.clicked], np.float64).reshape(-1, 3)

    def distance(self) -> float:
        """Length of the polyline in space."""
        return float(np.linalg.norm(np.diff(self.points(), axis=0), axis=1).sum())

    def distance_deviation(self) -> float:
        """Standard deviation of `distance`: a point inside the polyline moves both segments that it ends."""
        deviations = np.array([each.deviation for each in self.clicked])
        deviations[1:-1] *= 2.0
        return float(np.sqrt((deviations**2).sum()))

    def height_difference(self) -> float:
        """From the first point up to the last."""
        return float(self.clicked[-1].position[2] - self.clicked[0].position[2]) if self.clicked else 0.0

    def area(self) -> float:
        """Of the polygon of the points on the map (level), closed from the last to the first."""
        x, y = self.points()[:, :2].T
        return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))

    def to_markdown(self) -> str:
        """The measures, in Markdown."""
        if not self.clicked:
            return ""
        if len(self.clicked) == 1:
            return "Click the next place."
        level = float(np.linalg.norm(np.diff(self.points()[:, :2], axis=0), axis=1).sum())
        distance, deviation = self.distance(), self.distance_deviation()
        share = f", {100 * deviation / distance:.2g} %" if distance > 0 else ""
        lines = [
            f"distance **{distance:,.2f} {self._unit}** ± {deviation:,.2g}{share}",
            f"level {level:,.2f} {self._unit}; height difference **{self.height_difference():+,.2f} {self._unit}**, "
            "first to last",
        ]
        if len(self.clicked) > 2:
            square = f"{self._unit}²" if self._unit == "m" else f"square {self._unit}"
            lines.append(f"area **{self.area():,.2f} {square}** on the map")
        return "\n\n".join(lines)


@dataclass(frozen=True, eq=False)
class KnownDistance:
    """A distance that a person knows."""

    one: MeasuredPoint
    other: MeasuredPoint
    meters: float

    @property
    def meters_per_unit(self) -> float:
        """Metres in a unit of the ground frame, by this distance."""
        return self.meters / float(np.linalg.norm(self.one.position - self.other.position))


def known_distances_text(known: Sequence[KnownDistance]) -> str:
    """The file that `--scale-bar` takes. Numbers keep all digits."""
    lines = ["# Marks: NAME ray x y photograph. Distances: NAME NAME metres. Written by vdgs view."]
    for number, each in enumerate(known, 1):
        names = f"{number}a", f"{number}b"
        for name, point in zip(names, (each.one, each.other), strict=True):
            lines += [f"{name}\tray\t{x!r}\t{y!r}\t{photograph}" for photograph, x, y in point.rays]
        lines.append(f"{names[0]}\t{names[1]}\t{each.meters!r}")
    return "\n".join(lines) + "\n"
