"""Where places fall in the pictures of pinhole cameras, in float32 on any device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera


class PointProjection(NamedTuple):
    """Places of n points in a picture, or of c pictures; where `inside` is false, column and row say nothing."""

    column: Float[Tensor, "*c n"]
    row: Float[Tensor, "*c n"]
    #: Along the viewing direction, and straight from the camera, in world units.
    depth: Float[Tensor, "*c n"]
    distance: Float[Tensor, "*c n"]
    #: Whether the frustum holds the point: as `Camera.in_frustum`, but for rounding.
    inside: Bool[Tensor, "*c n"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Frusta:
    """c pinhole cameras as batched tensors."""

    camera_from_world: Float64[Tensor, "c 4 4"]
    fx: Float64[Tensor, " c"]
    fy: Float64[Tensor, " c"]
    cx: Float64[Tensor, " c"]
    cy: Float64[Tensor, " c"]
    width: Float64[Tensor, " c"]
    height: Float64[Tensor, " c"]

    @staticmethod
    def of(cameras: Sequence[Camera], device: torch.device | str = "cpu") -> Frusta:
        """O(c)."""
        rigid = np.stack([camera.camera_from_world for camera in cameras])
        inner = np.array([[c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in cameras], np.float64)
        fx, fy, cx, cy, width, height = torch.from_numpy(inner).to(device).T.contiguous()
        rigid_there = torch.from_numpy(rigid).to(device)
        return Frusta(camera_from_world=rigid_there, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    def select(self, chosen: Int64[Tensor, " some"]) -> Frusta:
        """The frusta at these indices."""
        return Frusta(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    @property
    def relative_extent(self) -> Float64[Tensor, " c"]:
        """What the longer side of each picture spans at the unit of depth."""
        return torch.maximum(self.width, self.height) / torch.maximum(self.fx, self.fy)

    def project(self, positions: Float[Tensor, "n 3"]) -> PointProjection:
        """Where the points fall in each picture, [c, n]. O(c n)."""
        rigid = self.camera_from_world.to(positions)
        local = positions @ rigid[:, :3, :3].transpose(1, 2) + rigid[:, None, :3, 3]
        fx, fy, cx, cy, width, height = (
            each[:, None].to(positions) for each in (self.fx, self.fy, self.cx, self.cy, self.width, self.height)
        )
        x, y, depth = local.permute(2, 0, 1).contiguous()
        divisor = depth.clamp(min=NEAR_PLANE)
        column, row = fx * x / divisor + cx, fy * y / divisor + cy
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depth > NEAR_PLANE)
        return PointProjection(column, row, depth, (x * x + y * y + depth * depth).sqrt(), inside)


def project_points(positions: Float[Tensor, "n 3"], camera: Camera) -> PointProjection:
    """Where the points fall in the picture of one camera. O(n)."""
    return PointProjection(*(each[0] for each in Frusta.of([camera], positions.device).project(positions)))
