"""Where structure-from-motion found its points in a photograph: what reprojection can be held against.

Kept as rays of the camera, not as pixels: they hold at any size of the photograph, undistorted or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vdgs.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class Sightings:
    """Points [m, 3] that a photograph shows, in the world of its camera, and where it shows them: x/z and y/z of the
    camera's rays [m, 2], all float64; and their numbers [m] int64, the same in all photographs of a capture."""

    points: np.ndarray
    rays: np.ndarray
    numbers: np.ndarray

    def errors_px(self, camera: Camera) -> np.ndarray:
        """Reprojection errors [m] in pixels of a pinhole camera in the same world; infinite behind it."""
        pixels, depth = camera.project(self.points)
        found = self.rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        distance = np.linalg.norm(pixels - found, axis=1)
        return np.where((depth > 0) & np.isfinite(distance), distance, np.inf)
