"""Gaussians and pictures for the tests of files."""

from __future__ import annotations

import numpy as np
import torch

from vdgs.geometry.camera import Camera
from vdgs.model.gaussian_transform import transform_gaussians
from vdgs.model.gaussians import Gaussians, render_gaussians


def random_gaussians(count: int, degree: int, seed: int = 0, reach: float = 3.0) -> Gaussians:
    """Scattered over a disc, of colors between 0 and 1 that change with the direction."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=(torch.rand(count, 3, generator=generator) * 2 - 1) * torch.tensor([reach, reach, reach / 5]),
        log_scales=normal(count, 3) * 0.5 - 1.8,
        quaternions=normal(count, 4),
        opacity_logits=normal(count) + 1,
        sh0=normal(count, 3) * 0.4,
        shN=normal(count, (degree + 1) ** 2 - 1, 3) * 0.2,
    )


def turned(gaussians: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Along other axes."""
    return transform_gaussians(gaussians, 1.0, matrix, np.zeros(3))


def overhead(height: float = 8.0, aside: float = 2.0, size: int = 96) -> Camera:
    """A camera above the origin that looks down at it aslant; +y of the ground is up in the picture."""
    position = np.array([aside, -aside, height])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return Camera(
        camera_from_world=matrix, fx=size * 1.0, fy=size * 1.0, cx=size / 2, cy=size / 2, width=size, height=size
    )


def picture(gaussians: Gaussians, camera: Camera | None = None) -> np.ndarray:
    """What a camera sees before black, RGB in 0 .. 1."""
    with torch.no_grad():
        raster, _ = render_gaussians(gaussians, camera or overhead(), torch.zeros(3), gaussians.sh_degree)
    return raster.image.clamp(0, 1).numpy()


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Of two pictures in 0 .. 1, dB."""
    return float(-10 * np.log10(np.mean((one - other) ** 2) + 1e-12))
