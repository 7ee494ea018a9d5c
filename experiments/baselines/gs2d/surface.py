"""What 2DGS adds to 3DGS: flat Gaussians, depth distortion and normal consistency.

Source: Huang, Yu, Chen, Geiger and Gao, "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", SIGGRAPH
2024 (2DGS below); "program" is the authors' published program. Adapted:

- a disk is a Gaussian of which one scale is a hundredth of the larger of the others, projected as those of 3DGS are, in
  place of the intersection of ray and disk (its section 4.2), so that a Gaussian has one depth in a view;
- distances along a ray are squared differences of the logarithms of depths, in place of depths in NDC (program), which
  near and far plane scale: a capture's units say nothing. Where its NDC turn 100 (unbounded scenes) into about 1 of
  squared relative depth, the weight is 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from experiments.baselines.gs3d.training import Gs3dConfig, Gs3dProblem
from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.kernels.rotations import rotation_matrices
from vdgs.model.gaussians import Gaussians, project_splats

#: Normals of depths are compared where a pixel and its neighbors are at least so opaque.
_LEAST_ALPHA = 0.5


@dataclass(frozen=True)
class Gs2dConfig(Gs3dConfig):
    """3DGS with the terms of 2DGS (its section 4.3). With zeros it is 3DGS."""

    flatness: float = 0.01
    """The third scale is at most this share of the larger of the others (choice); 0: it is free."""
    distortion: float = 1.0
    """Weight of depth distortion (eq. 13; value: choice, see above)."""
    distortion_start: float = 0.1
    """Share of the iterations after which it counts (program: 3000 of 30 000)."""
    normal: float = 0.05
    """beta: weight of normal consistency (eq. 14)."""
    normal_start: float = 7 / 30
    """Share of the iterations after which it counts (program: 7000 of 30 000)."""


def with_surface_terms(stage: Gs3dProblem) -> Gs3dProblem:
    """The problem of 3DGS with what its settings, of 2DGS, add."""
    assert isinstance(stage.config, Gs2dConfig)
    is_plain = stage.config.distortion == stage.config.normal == 0
    return replace(
        stage,
        surface_loss=None if is_plain else partial(surface_loss, stage.config),
        constrain=partial(flatten, share=stage.config.flatness) if stage.config.flatness else None,
    )


def flatten(gaussians: Gaussians, share: float) -> None:
    """Bound the third scale of each Gaussian, in place."""
    scales = gaussians.log_scales
    scales[:, 2] = torch.minimum(scales[:, 2], scales[:, :2].amax(dim=1) + math.log(share))


def surface_loss(config: Gs2dConfig, gaussians: Gaussians, camera: Camera, iteration: int) -> Float[Tensor, ""]:
    """Both terms of a view, each from its start on."""
    done, loss = iteration / config.iterations, gaussians.means.new_zeros(())
    due = {
        "distortion": config.distortion * (done >= config.distortion_start),
        "normal": config.normal * (done >= config.normal_start),
    }
    if not any(due.values()):
        return loss
    splats = project_splats(gaussians, camera, 0)
    rotation, shift = (torch.from_numpy(each.astype(np.float32)).to(gaussians.means)
                       for each in (camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]))  # fmt: skip
    places = gaussians.means @ rotation.T + shift
    drawn = _draw_depths(splats, places[:, 2], camera)
    if due["distortion"]:
        loss = loss + due["distortion"] * depth_distortion(drawn).mean()
    if due["normal"]:
        normals = _facing_normals(gaussians, rotation, places.detach())
        of_splats = _draw(replace(splats, colors=normals), camera).image
        loss = loss + due["normal"] * normal_disagreement(of_splats, drawn, camera).mean()
    return loss


def _draw(splats: Splats, camera: Camera) -> Raster:
    black = splats.means_px.new_zeros(3)
    colors = splats.colors.contiguous()
    return get_backend(black.device).rasterize(replace(splats, colors=colors), black, camera.width, camera.height)


def _draw_depths(splats: Splats, depths: Float[Tensor, " n"], camera: Camera) -> Raster:
    """In place of colors: the logarithm of the depth, its square, and the depth, each summed by weight. Logarithms are
    those of depths over the middle one, which changes no difference and keeps squares small."""
    depths = depths.clamp(min=NEAR_PLANE)
    logs = (depths / depths.detach().median()).log()
    return _draw(replace(splats, colors=torch.stack([logs, logs.square(), depths], dim=1)), camera)


def depth_distortion(drawn: Raster) -> Float[Tensor, "h w"]:
    """The sum over pairs of splats of w_i w_j (m_i - m_j)^2, where m is the logarithm of the depth (eq. 13)."""
    first, second = drawn.image[..., 0], drawn.image[..., 1]
    return 2 * (drawn.alpha * second - first.square())


def _facing_normals(
    gaussians: Gaussians, rotation: Float[Tensor, "3 3"], places: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """The axes of the least scales in the camera's frame, turned towards the camera."""
    thin = gaussians.log_scales.detach().argmin(dim=1)[:, None, None].expand(-1, 3, 1)
    normals = torch.gather(rotation_matrices(gaussians.quaternions), 2, thin)[..., 0] @ rotation.T
    return normals * torch.where((normals * places).sum(dim=-1, keepdim=True) > 0, -1.0, 1.0)


def normal_disagreement(
    normals: Float[Tensor, "h w 3"], drawn: Raster, camera: Camera
) -> Float[Tensor, "rows columns"]:
    """The sum over splats of w_i (1 - n_i . N), where N is the normal of the expected depth (eq. 14), without the outer
    pixels; 0 where too little is drawn."""
    shown = drawn.alpha.detach() > _LEAST_ALPHA
    depth = torch.where(shown, drawn.image[..., 2] / drawn.alpha.clamp(min=_LEAST_ALPHA), 1.0)
    x, y = ((torch.arange(count) + 0.5 - middle) / focal for count, middle, focal in
            ((camera.width, camera.cx, camera.fx), (camera.height, camera.cy, camera.fy)))  # fmt: skip
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    places = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1).to(depth) * depth[..., None]
    across, down = places[1:-1, 2:] - places[1:-1, :-2], places[2:, 1:-1] - places[:-2, 1:-1]
    of_depth = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)  # towards the camera: -z
    whole = shown[1:-1, 1:-1] & shown[1:-1, 2:] & shown[1:-1, :-2] & shown[2:, 1:-1] & shown[:-2, 1:-1]
    return (drawn.alpha[1:-1, 1:-1].detach() - (normals[1:-1, 1:-1] * of_depth).sum(dim=-1)) * whole
