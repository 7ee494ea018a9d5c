"""Where places fall in the picture of a pinhole camera, in float32 on any device."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.cameras import NEAR, Camera


class Projection(NamedTuple):
    """Places of n points in a picture; where `inside` is false, column and row say nothing."""

    column: Float[Tensor, " n"]
    row: Float[Tensor, " n"]
    #: Along the viewing direction, and straight from the camera, in world units.
    depth: Float[Tensor, " n"]
    distance: Float[Tensor, " n"]
    #: Whether the frustum holds the point: as `Camera.sees`, but for rounding.
    inside: Bool[Tensor, " n"]


def project(positions: Float[Tensor, "n 3"], camera: Camera) -> Projection:
    """Where the points fall. O(n)."""
    rigid = torch.as_tensor(camera.camera_from_world).to(positions)
    x, y, depth = (positions @ rigid[:3, :3].T + rigid[:3, 3]).T.contiguous()
    divisor = depth.clamp(min=NEAR)
    column, row = camera.fx * x / divisor + camera.cx, camera.fy * y / divisor + camera.cy
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (depth > NEAR)
    return Projection(column, row, depth, (x * x + y * y + depth * depth).sqrt(), inside)
