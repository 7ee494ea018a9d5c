"""The ground frame: z up, in metres where the scale is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.geometry.similarity import Similarity

#: What a unit of coordinates is called whose size nobody knows.
UNKNOWN_UNIT = "units"


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundFrame(Similarity):
    """The similarity that brings the capture's own world into the ground frame (z up)."""

    #: True where one unit of the ground frame is one metre.
    metric: bool
    #: How the up axis and the scale were found, for people ("GPS of 18 images", "least variance", ...).
    description: str
    #: Latitude (deg), longitude (deg), altitude (m) of the ground frame's origin (ENU), where known.
    origin_geo: tuple[float, float, float] | None = None
    #: Latitude and longitude (deg) of the place whose east, north and up are the axes, where it is not the origin: a
    #: frame that is moved keeps its axes.
    axes_geo: tuple[float, float] | None = None

    #: The accuracy of place and scale, and the method that found both, in words; empty where unknown.
    accuracy: str = ""
    method: str = ""

    @property
    def axes_origin(self) -> tuple[float, float]:
        """Latitude and longitude (deg) of the place whose east, north and up are the axes (georeferenced frames)."""
        if self.origin_geo is None:
            raise ValueError("a frame that is not georeferenced is level at no known place")
        return self.axes_geo or self.origin_geo[:2]

    @property
    def is_moved_site(self) -> bool:
        """Whether the capture's own world is metres, z up, without a place on Earth, and was moved by whole metres, for
        precision alone: people know the place by the coordinates of that world (of a site's grid)."""
        shift, turned = self.translation, self.scale != 1 or not np.array_equal(self.rotation, np.eye(3))
        moved = bool(shift.any()) and np.array_equal(shift, np.round(shift))
        return self.metric and self.origin_geo is None and moved and not turned

    @property
    def unit(self) -> str:
        """What one unit of the ground frame is called."""
        return "m" if self.metric else UNKNOWN_UNIT

    @property
    def axis_names(self) -> tuple[str, str]:
        """What x and y are called in figures, with their unit: east and north where the frame is georeferenced."""
        east, north = ("east", "north") if self.origin_geo else ("x", "y")
        return f"{east} ({self.unit})", f"{north} ({self.unit})"

    def to_ground(self, points: np.ndarray) -> np.ndarray:
        """Source points [n, 3] to the ground frame."""
        return self.apply(points)
