"""What a capture is, once it has been read and checked: cameras, points, a ground frame, a split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from vdgs.geometry.camera import Camera
from vdgs.geometry.ground_frame import GroundFrame


@dataclass(frozen=True, eq=False)
class Observations:
    """Points [m, 3] that a photograph shows, in the world of its camera, and where it shows them: x/z and y/z of the
    camera's rays [m, 2], all float64; and their numbers [m] int64, the same in all photographs of a capture."""

    points: np.ndarray
    rays: np.ndarray
    point_ids: np.ndarray

    def reprojection_errors_px(self, camera: Camera) -> np.ndarray:
        """Reprojection errors [m] in pixels of a pinhole camera in the same world; infinite behind it."""
        pixels, depth = camera.project(self.points)
        found = self.rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        distance = np.linalg.norm(pixels - found, axis=1)
        return np.where((depth > 0) & np.isfinite(distance), distance, np.inf)


Split = Literal["train", "test"]


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """One photograph: its camera in the ground frame, at the size at which it is used."""

    name: str
    camera: Camera
    image_path: Path
    mask_path: Path | None
    split: Split
    #: Some of the points that the capture says this photograph shows, where it says so (ground frame).
    observations: Observations | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        for name, path in (("image_path", self.image_path), ("mask_path", self.mask_path)):
            if not isinstance(path, Path) and not (name == "mask_path" and path is None):
                raise TypeError(
                    f"{name} must be pathlib.Path, not {type(path).__name__}: vdgs.write_capture(FOLDER, images, "
                    "cameras) writes pictures in memory as a capture"
                )


@dataclass(frozen=True, eq=False, kw_only=True)
class Capture:
    """A folder of photographs with cameras and sparse points, checked, in the ground frame."""

    root: Path
    #: The format it was read from ("colmap", "transforms", "mega-nerf", "matrixcity", "mvsnet", "llff").
    source: str
    #: The image folder in use, relative to root ("images_4").
    images: str
    views: tuple[View, ...]
    #: Sparse points [n, 3] float64 in the ground frame, and their colors [n, 3] uint8.
    points: np.ndarray
    point_colors: np.ndarray
    ground: GroundFrame
    #: What a person should know but need not mend.
    warnings: tuple[str, ...] = field(default=())
    #: By what --downscale shrinks the photographs of that folder.
    downscale: float = 1.0
    #: Photographs that are there and not used: without a camera, or left out by an option.
    num_unused_images: int = 0
    #: Photographs from where nobody flew (`captures.off_path`), which are measured by themselves.
    off_path_views: tuple[View, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Capture({str(self.root)!r}, {self.source}, images={self.images!r}: {len(self.train_views)} training and "
            f"{len(self.test_views)} test views, {len(self.points):,} points, unit: {self.ground.unit})"
        )

    @property
    def train_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "train")

    @property
    def test_views(self) -> tuple[View, ...]:
        return tuple(view for view in self.views if view.split == "test")


def spread_evenly(views: Sequence[View], most: int) -> tuple[View, ...]:
    """At most so many of the views, spread over all of them."""
    return tuple(views[k] for k in np.unique(np.linspace(0, len(views) - 1, most).round().astype(int)))
