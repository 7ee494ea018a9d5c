"""How many cameras see each point: V_i of the visibility map (VDGS section IV-B, eq. 5).

A camera sees a point where its frustum holds it: z > near and the projected center on the image. Nothing
is hidden behind anything else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from vdgs import kernels
from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.transfer import is_host, to_like

#: Places that all cameras are asked about at once: with a thousand cameras 64 MB.
PLACES_AT_ONCE = 1 << 14


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


def fade_factors(
    points: Float[Tensor, "n 3"], cameras: Sequence[Camera], least: int, margin: float
) -> Float[Tensor, " n"]:
    """h²(3 - 2h) of each point with h = 1 - s / margin, within [0, 1]: s is the least-th smallest share of their longer
    side by which pictures would have to be larger on each side to show it (0: they do), infinite behind a camera.

    Float32. All are 1 where `least` is 0; 0 where there are fewer cameras, and for a point that is not finite. Raises
    TypeError or ValueError as `count_visibility`.
    """
    # Where there is a kernel for it, counting tells for less what need not be looked at.
    count = count_visibility if is_host(points) else kernels.get_backend(points.device).count_visibility
    factors = (count(points, cameras) >= least).float()
    edge = torch.nonzero(factors == 0)[:, 0]
    edge = edge[count(points[edge], [_widened(each, margin) for each in cameras]) >= least]
    for some in edge.split(PLACES_AT_ONCE) if len(edge) else ():
        places = points[some].T.contiguous()
        outside = torch.stack([_share_outside(places, camera) for camera in cameras], dim=1)
        held = (1 - outside.kthvalue(least, dim=1).values / margin).clamp(0, 1)
        factors[some] = (held * held * (3 - 2 * held)).float()
    return factors


def _widened(camera: Camera, margin: float) -> Camera:
    """A camera whose picture shows all on each side that has not faded out."""
    more = math.ceil(margin * max(camera.width, camera.height))
    return replace(
        camera, width=camera.width + 2 * more, height=camera.height + 2 * more, cx=camera.cx + more,
        cy=camera.cy + more, uncropped_size=None,
    )  # fmt: skip


def _share_outside(places: Float[Tensor, "3 n"], camera: Camera) -> Float[Tensor, " n"]:
    """How far places lie outside of a picture, in its longer sides; infinite behind the camera, 0 or less inside."""
    longest, is_pinhole = max(camera.width, camera.height), camera.model == "pinhole"
    fx, cx, half_width = camera.fx / longest, (camera.cx - camera.width / 2) / longest, camera.width / 2 / longest
    fy, cy, half_height = camera.fy / longest, (camera.cy - camera.height / 2) / longest, camera.height / 2 / longest
    lens = np.array([[fx, 0, cx * is_pinhole], [0, fy, cy * is_pinhole], [0, 0, 1]])  # from the picture's middle
    pose = torch.from_numpy(lens @ camera.camera_from_world[:3]).to(places)
    column, row, z = torch.addmm(pose[:, 3:], pose[:, :3], places)
    if is_pinhole:
        column, row = column.div_(z), row.div_(z)
    else:
        column, row = column.add_(cx), row.add_(cy)
    outside = torch.maximum(column.abs_().sub_(half_width), row.abs_().sub_(half_height))
    return torch.where(z > NEAR_PLANE, outside, math.inf)


def check_points(points: Tensor) -> None:
    """Raise a clear error unless these are points [n, 3]."""
    if points.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"points must be float32 or float64, not {points.dtype}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must be [n, 3], not {list(points.shape)}")
