"""Explicit Gaussians, each with its own shape, opacity and spherical harmonics: what 3DGS trains, and what an anchor
model is baked into.

Dimensions: n Gaussians, r = (degree + 1)² - 1 further coefficients of color. Float32, ground frame. Source: Kerbl,
Kopanas, Leimkühler and Drettakis, "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023 (3DGS); its
equations 5 and 6 are in `kernels.project`, 2 and 3 in `kernels.rasterize`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.gaussian_projection import variances_px2
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.spherical_harmonics import eval_sh_colors
from vdgs.model.scale_bounds import MAX_SIGMA

#: Gaussians, merged ones or not.
AnyGaussians = TypeVar("AnyGaussians", bound="Gaussians")


@dataclass(frozen=True, kw_only=True)
class Gaussians:
    """Gaussians by their parameters, as 3DGS trains them. Tensors share their first dimension."""

    means: Float[Tensor, "n 3"]
    #: Logarithms of the standard deviations along the Gaussian's own axes.
    log_scales: Float[Tensor, "n 3"]
    #: Rotations, wxyz, of any length but zero.
    quaternions: Float[Tensor, "n 4"]
    #: Opacities before the sigmoid.
    opacity_logits: Float[Tensor, " n"]
    #: Spherical harmonics: coefficients of the constant function, and of the others.
    sh0: Float[Tensor, "n 3"]
    shN: Float[Tensor, "n r 3"]

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def select(self: AnyGaussians, rows: Tensor) -> AnyGaussians:
        """The Gaussians of the given rows (indices or mask)."""
        rows = (rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows).to(self.means.device)
        return replace(self, **{name: tensor.index_select(0, rows) for name, tensor in self.tensors().items()})

    def float(self: AnyGaussians) -> AnyGaussians:
        """The same numbers in float32."""
        return replace(self, **{name: tensor.float() for name, tensor in self.tensors().items()})

    def to(self: AnyGaussians, device: torch.device | str) -> AnyGaussians:
        """The same Gaussians on a device; the same tensors where they are on it."""
        return replace(self, **{name: tensor.to(device) for name, tensor in self.tensors().items()})

    def concat(self: AnyGaussians, more: AnyGaussians) -> AnyGaussians:
        """These Gaussians followed by others."""
        return replace(self, **{name: torch.cat([t, more.tensors()[name]]) for name, t in self.tensors().items()})

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics that there is room for."""
        return math.isqrt(self.shN.shape[1] + 1) - 1


@dataclass(frozen=True, kw_only=True)
class NodeGaussians(Gaussians):
    """Gaussians that stand for others, their members (`gaussian_merging.single_members`): also for more than they can
    cover themselves, as where surfaces lie behind each other."""

    #: What the members cover, in parts of what the Gaussian covers where it is opaque; 1 where it is less.
    covers: Float[Tensor, " n"]
    #: Mean and standard deviation of the logarithms of the members' weights (`gaussian_merging.gaussian_weights`), each
    #: counted by its weight.
    log_weight_mean: Float[Tensor, " n"]
    log_weight_std: Float[Tensor, " n"]
    #: By how much the members' colors count for more, or less, than their weights.
    color_weight: Float[Tensor, " n"]
    #: Covariance of the members' `sh0` with the logarithms of their weights, each counted by its weight: what the large
    #: ones look like, which are still drawn from afar.
    sh0_log_weight_cov: Float[Tensor, "n 3"]


@torch.no_grad()
def visible_gaussian_rows(gaussians: Gaussians, camera: Camera) -> Int64[Tensor, " v"]:
    """Rows of the Gaussians in front of the camera whose extent touches the image, ascending."""
    kernels = get_backend(gaussians.means.device)
    seen = kernels.project(gaussians.means, gaussians.log_scales.exp(), gaussians.quaternions, camera)
    reach = MAX_SIGMA * variances_px2(seen.conics).sqrt()
    low, high = seen.means_px + reach, seen.means_px - reach
    inside = (low > 0).all(-1) & (high[:, 0] < camera.width) & (high[:, 1] < camera.height)
    # A needle whose determinant is lost to rounding has no extent that could be compared: it is drawn.
    return (seen.valid & (inside | ~torch.isfinite(reach).all(-1))).nonzero()[:, 0]


def render_gaussians(
    gaussians: Gaussians, camera: Camera, background: Float[Tensor, "3"], degree: int, depth: bool = False
) -> tuple[Raster, Float[Tensor, "n 2"]]:
    """The picture, and the centers in pixels that it was drawn from (growth asks for their gradient).

    Differentiable in all tensors of `gaussians`.
    """
    splats = project_splats(gaussians, camera, degree)
    kernels = get_backend(gaussians.means.device)
    return kernels.rasterize(splats, background, camera.width, camera.height, depth=depth), splats.means_px


def project_splats(gaussians: Gaussians, camera: Camera, degree: int) -> Splats:
    """The splats of a view, with opacity 0 where none is to be drawn."""
    kernels = get_backend(gaussians.means.device)
    projected = kernels.project(gaussians.means, gaussians.log_scales.exp(), gaussians.quaternions, camera)
    if camera.model == "pinhole":
        center = torch.from_numpy(camera.position.astype(np.float32)).to(gaussians.means)
        directions = torch.nn.functional.normalize(gaussians.means - center, dim=-1)
    else:
        directions = torch.from_numpy(camera.forward.astype(np.float32)).to(gaussians.means).expand(len(gaussians), 3)
    return Splats(
        projected.means_px, projected.conics, projected.depths,
        eval_sh_colors(gaussians.sh0, gaussians.shN, directions, degree),
        torch.where(projected.valid, gaussians.opacity_logits.sigmoid(), 0.0),
    )  # fmt: skip
