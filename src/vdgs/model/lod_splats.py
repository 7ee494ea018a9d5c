"""How the merged Gaussians of a level-of-detail tree are drawn: as their members would be, without aliasing."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import ALPHA_MIN, DILATION_PX2
from vdgs.kernels.kernel_types import Splats
from vdgs.model.gaussians import NodeGaussians, project_splats
from vdgs.model.renderer import compensated_splats

#: Logarithms of weights are taken to differ by at least so much among the members of a Gaussian, also where it has one
#: (they are divided by it), and by no more than so much: beyond, float32 lacks the second term below.
LOG_STDS = 1e-2, 3.0
#: Where the mean lies more than so many standard deviations below what is drawn, no member is drawn.
MAX_STDS = 6.0


def merged_splats(gaussians: NodeGaussians, camera: Camera) -> Splats:
    """The splats of merged Gaussians in a view, without aliasing: the blur that the model has learnt is part of them
    (`export.lod_bake`). One that covers several times as much as itself is drawn as so many behind each other, each as
    transparent as the blur makes it; members that are too small to be drawn are not among these (`shown_shares`)."""
    splats = project_splats(gaussians, camera, gaussians.sh_degree)
    shares = compensated_splats(replace(splats, opacities=torch.ones_like(splats.opacities)), camera, 0.0).opacities
    shown = shown_shares(gaussians, splats.depths, camera)
    # 1 - (1 - share) ** covers, and with the layers that are left.
    layers = gaussians.covers * torch.log1p(-shares)
    whole, thinned = (splats.opacities * -torch.expm1(layers * left) for left in (1.0, shown))
    # What the rasterizer cuts off this splat itself has been counted with its members.
    drawn = torch.minimum(whole, thinned + ALPHA_MIN)
    return replace(splats, opacities=torch.where(shown > 0, drawn, 0))


def shown_shares(gaussians: NodeGaussians, depths: Float[Tensor, " n"], camera: Camera) -> Float[Tensor, " n"]:
    """How much of what the members of merged Gaussians cover would be drawn in a view, if they were drawn themselves.

    A member of weight w (opacity times area) that is smaller than a pixel has an alpha of w / (0.3 p²) at its center,
    where p is the size of a pixel there; nothing is drawn below `ALPHA_MIN`. Of what it covers there is left
    1 - t / w with t = `ALPHA_MIN` 0.3 p², nothing where w < t. The logarithms of weights are taken for normally
    distributed, with mean m and standard deviation s: the mean of max(0, 1 - t / w) is then
    N(d) - t exp(s² / 2 - m) N(d - s), d = (m - log t) / s, N the standard normal distribution. Right to 0.002.
    """
    pixels = torch.ones_like(depths) if camera.model == "orthographic" else depths**2
    least = (ALPHA_MIN * DILATION_PX2 / (camera.fx * camera.fy) * pixels).clamp_min(1e-30).log()
    std = gaussians.log_weight_std.clamp(*LOG_STDS)
    below = least - gaussians.log_weight_mean
    distance = (-below / std).clamp_min(-MAX_STDS)
    cut = (below + std**2 / 2).exp() * torch.special.ndtr(distance - std)
    shown = (torch.special.ndtr(distance) - cut).clamp(0, 1)
    return torch.where(distance > -MAX_STDS, shown, 0)
