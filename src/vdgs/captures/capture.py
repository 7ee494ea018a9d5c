"""What a capture is, once it has been read and checked: cameras, points, a ground frame, a split."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from vdgs.captures.sightings import Sightings
from vdgs.geometry.camera import Camera
from vdgs.geometry.similarity import Similarity

Split = Literal["train", "test"]


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundFrame(Similarity):
    """The similarity that brings the capture's own world into the ground frame (z up)."""

    #: True where one unit of the ground frame is one metre.
    metric: bool
    #: How the up axis and the scale were found, for people ("GPS of 18 images", "least variance", ...).
    how: str
    #: Latitude (deg), longitude (deg), altitude (m) of the ground frame's origin (ENU), where known.
    origin_geo: tuple[float, float, float] | None = None
    #: Latitude and longitude (deg) of the place whose east, north and up are the axes, where it is not the origin: a
    #: frame that is moved keeps its axes.
    axes_geo: tuple[float, float] | None = None

    @property
    def level_at(self) -> tuple[float, float]:
        """Latitude and longitude (deg) of the place whose east, north and up are the axes (georeferenced frames)."""
        if self.origin_geo is None:
            raise ValueError("a frame that is not georeferenced is level at no known place")
        return self.axes_geo or self.origin_geo[:2]

    @property
    def unit(self) -> str:
        """What one unit of the ground frame is called."""
        return "m" if self.metric else "units"

    @property
    def axis_names(self) -> tuple[str, str]:
        """What x and y are called in figures, with their unit: east and north where the frame is georeferenced."""
        east, north = ("east", "north") if self.origin_geo else ("x", "y")
        return f"{east} ({self.unit})", f"{north} ({self.unit})"

    def to_ground(self, points: np.ndarray) -> np.ndarray:
        """Source points [n, 3] to the ground frame."""
        return self.apply(points)


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """One photograph: its camera in the ground frame, at the size at which it is used."""

    name: str
    camera: Camera
    image_path: Path
    mask_path: Path | None
    split: Split
    #: Some of the points that the capture says this photograph shows, where it says so (ground frame).
    sightings: Sightings | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """A folder of photographs with cameras and sparse points, checked, in the ground frame."""

    root: Path
    #: The format it was read from ("colmap", "transforms", "mega-nerf", "matrixcity").
    source: str
    #: The image folder in use, relative to root ("images_4").
    images: str
    views: tuple[View, ...]
    #: Sparse points [n, 3] float64 in the ground frame, and their colours [n, 3] uint8.
    points: np.ndarray
    point_colours: np.ndarray
    ground: GroundFrame
    #: What a person should know but need not mend.
    warnings: tuple[str, ...] = field(default=())

    @property
    def train_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "test")
