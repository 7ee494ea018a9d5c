"""Baked Gaussians with one color for all directions, for files that hold no others or that are no better for them.

The constant part of spherical harmonics is the mean over all directions, and cameras of a flight look from a few: from
these a Gaussian has another color. Its fixed color is the mean of what the training cameras see, weighted as near
pixels weigh, which draws views as well as a scene that was baked without changing colors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vdgs.export.formats.export_scene import CHUNK_SIZE, ExportScene
from vdgs.export.formats.gaussian_store import GaussianStore, write_store
from vdgs.geometry.camera import Camera
from vdgs.kernels.spherical_harmonics import eval_sh_colors, rgb_to_sh
from vdgs.model.gaussians import Gaussians, visible_gaussian_rows
from vdgs.system.stop_signals import check_stop_requested

#: Where no camera sees a Gaussian, its color is that from all cameras, with so little weight that any other counts.
UNSEEN_WEIGHT = 1e-9


def write_with_fixed_colors(store: GaussianStore, cameras: Sequence[Camera], file: Path) -> GaussianStore:
    """The Gaussians of a store with fixed colors (degree 0), in a temporary file that the caller removes."""

    def pieces() -> Iterator[Gaussians]:
        for first in range(0, len(store.means), CHUNK_SIZE):
            yield with_fixed_colors(store.rows(np.arange(first, min(first + CHUNK_SIZE, len(store.means)))), cameras)
            store.release_pages()

    return write_store(ExportScene(chunks=pieces(), count=len(store.means), degree=0), file)


@torch.no_grad()
def with_fixed_colors(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Gaussians of degree 0 in the colors in which the cameras see them. Only what lies in a camera's picture counts,
    whatever stands before it; a Gaussian in no picture takes the mean over all cameras."""
    total = gaussians.sh0.new_zeros(len(gaussians), 4)
    for camera in cameras:
        check_stop_requested()
        rows = visible_gaussian_rows(gaussians, camera)
        if len(rows):
            total.index_add_(0, rows, _weighted_colors(gaussians.select(rows), camera))
    if len(unseen := (total[:, 3] == 0).nonzero()[:, 0]):
        for camera in cameras:
            total.index_add_(0, unseen, UNSEEN_WEIGHT * _weighted_colors(gaussians.select(unseen), camera))
    colors = total[:, :3] / total[:, 3:]
    return Gaussians(**{**gaussians.tensors(), "sh0": rgb_to_sh(colors), "shN": gaussians.shN[:, :0]})


def _weighted_colors(gaussians: Gaussians, camera: Camera) -> Tensor:
    """RGB from a camera times a weight, and the weight, [n, 4]: pixels fall with the square of the distance."""
    rays = gaussians.means - torch.from_numpy(camera.position.astype(np.float32))
    weights = rays.square().sum(1, keepdim=True).clamp_min(1e-12).reciprocal()
    directions = torch.nn.functional.normalize(rays, dim=1)
    colors = eval_sh_colors(gaussians.sh0, gaussians.shN, directions, gaussians.sh_degree)
    return torch.cat([weights * colors, weights], 1)
