"""Where a picture shows ground and not sky: below the horizon."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from vdgs.geometry.camera import Camera

#: Rays that lead down by at least this much, in degrees, end on the ground (choice: as far as the vertical of a capture
#: without GPS may be wrong).
BELOW_HORIZON_DEG = 5.0


def below_horizon(camera: Camera, rows: int, columns: int) -> Bool[np.ndarray, "rows columns"]:
    """Cells through whose center the view leads down (z is up)."""
    if camera.model == "orthographic":
        return np.full((rows, columns), camera.forward[2] < 0)
    x = ((np.arange(columns) + 0.5) * (camera.width / columns) - camera.cx) / camera.fx
    y = ((np.arange(rows) + 0.5) * (camera.height / rows) - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((rows, columns))], axis=-1)
    up = rays @ camera.camera_from_world[:3, 2] / np.linalg.norm(rays, axis=-1)
    return up < -np.sin(np.radians(BELOW_HORIZON_DEG))
