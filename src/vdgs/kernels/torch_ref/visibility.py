"""How many cameras see each point: V_i of the visibility map (VDGS section IV-B, eq. 5).

A camera sees a point where its frustum holds it: z > near and the projected center on the image. Nothing
is hidden behind anything else.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.transfer import to_like


def count_visibility(points: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Int32[Tensor, "n"]:
    """V_i: the number of `cameras` whose frustum holds each point. O(n · cameras) time, O(n) memory.

    Points are float32 or float64, pinhole and orthographic cameras may be mixed. A point that is not
    finite is in no view. Raises TypeError or ValueError for other points.
    """
    check_points(points)
    count = points.new_zeros(points.shape[0], dtype=torch.int32)
    for camera in cameras:
        count += mark_visible(points, camera)
    return count


def mark_visible(points: Float[Tensor, "n 3"], camera: Camera) -> Bool[Tensor, "n"]:
    """Which points one camera sees: as `Camera.in_frustum`, on the device of the points."""
    check_points(points)
    exact = points.detach().to(torch.float64)
    finite = torch.isfinite(exact).all(dim=1)
    rigid = to_like(camera.camera_from_world, exact)
    x, y, z = (torch.where(finite[:, None], exact, 0.0) @ rigid[:3, :3].T + rigid[:3, 3]).unbind(1)
    divisor = z if camera.model == "pinhole" else torch.ones_like(z)
    column, row = camera.fx * x / divisor + camera.cx, camera.fy * y / divisor + camera.cy
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return finite & (z > NEAR_PLANE) & inside


def check_points(points: Tensor) -> None:
    """Raise a clear error unless these are points [n, 3]."""
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"points must be float32 or float64, not {points.dtype}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must be [n, 3], not {list(points.shape)}")
