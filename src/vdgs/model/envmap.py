"""What lies beyond the scene: colors by direction (an environment map), drawn behind all Gaussians.

The map is a picture [rows, columns, 3] of the whole sphere. Columns are azimuths from -pi, counterclockwise from +x, of
the ground frame. Rows go from straight up to straight down and are denser at the horizon, where land and sky meet in an
edge: row r of n lies at the elevation (pi/2) s|s| with s = 1 - 2 r / (n - 1).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera


def ray_directions(camera: Camera, device: torch.device | str = "cpu") -> Float[Tensor, "h w 3"]:
    """Unit directions in the ground frame of the rays through the pixel centers of a pinhole camera."""
    x = (torch.arange(camera.width, dtype=torch.float32, device=device) + (0.5 - camera.cx)) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float32, device=device) + (0.5 - camera.cy)) / camera.fy
    axes = torch.tensor(camera.camera_from_world[:3, :3], dtype=torch.float32, device="cpu").to(device)
    rays = x[None, :, None] * axes[0] + (y[:, None, None] * axes[1] + axes[2])
    return rays / rays.norm(dim=-1, keepdim=True)


def ray_angles(directions: Float[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Azimuth in [-pi, pi] and elevation in [-pi/2, pi/2] of unit directions."""
    return torch.atan2(directions[..., 1], directions[..., 0]), torch.asin(directions[..., 2].clamp(-1, 1))


def sample_envmap(
    envmap: Float[Tensor, "rows columns c"], directions: Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w c"]:
    """Colors of an environment map along unit directions: bilinear, round the sphere, differentiable by the map."""
    azimuth, elevation = ray_angles(directions)
    up = elevation.abs().mul_(2 / math.pi).sqrt_().copysign_(elevation)
    grid = torch.stack([azimuth / math.pi, -up], dim=-1)[None]
    # The first column again, at the other end.
    closed = torch.cat([envmap, envmap[:, :1]], dim=1).permute(2, 0, 1)[None]
    colors = torch.nn.functional.grid_sample(closed, grid, padding_mode="border", align_corners=True)
    return colors[0].permute(1, 2, 0)


def row_elevations(rows: int) -> Float[Tensor, " rows"]:
    """Elevations of the rows of a map, in radians."""
    s = torch.linspace(1, -1, rows, dtype=torch.float32, device="cpu")
    return math.pi / 2 * s * s.abs()


def check_envmap(envmap: Tensor) -> None:
    """Raise ValueError unless it is a map of at least two rows and columns."""
    if envmap.ndim != 3 or envmap.shape[2] != 3 or min(envmap.shape[:2]) < 2:
        raise ValueError(f"the environment map has shape {tuple(envmap.shape)}, not (rows, columns, 3)")
