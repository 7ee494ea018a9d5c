"""Splats of Gaussians that stand for others, as their members would be drawn without aliasing, in plain torch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import ALPHA_MIN, DILATION_PX2
from vdgs.kernels.gaussian_projection import GaussianShapes, project_gaussians
from vdgs.kernels.kernel_types import SPLAT_TENSORS, MergedGaussians, Splats
from vdgs.kernels.spherical_harmonics import eval_sh_colors

#: Logarithms of weights are taken to differ by at least so much among the members of a Gaussian, also where it has one
#: (they are divided by it), and by no more than so much (choice).
LOG_STDS = 1e-2, 3.0
#: Where the mean lies more than so many standard deviations below what is drawn, no member is drawn.
MAX_STDS = 6.0
#: Numbers that are divided by, or whose logarithms are taken, are taken for at least so much.
LEAST_WEIGHT = 1e-30


def merged_splats(parts: Sequence[MergedGaussians], camera: Camera, before: Splats | None = None) -> Splats:
    """The splats of merged Gaussians in a view, part after part, behind those that come `before`, without aliasing;
    opacity 0 where none is to be drawn and, if an implementation wants, where no pixel of the image shows any.

    A splat is as much more transparent as the blur of a pixel enlarges it (Mip-Splatting, eq. 9): the blur that a model
    has learnt is part of its merged Gaussians. One that covers several times as much as itself is drawn as so many
    behind each other; members that are too small to be drawn are not among these (`shown_members`), and its color is
    that of the others. Computed in float64, given in the precision of the means. Not differentiable.
    """
    g = _joined(parts)
    degree = math.isqrt(g.shN.shape[1] + 1) - 1
    projection = project_gaussians(g.means, GaussianShapes(g.log_scales.exp(), g.quaternions), camera)
    seen, shares = projection.projected, projection.compensation
    # Members fade as the Gaussian does that stands for them.
    assert g.opacity_factors is not None
    faded = g.log_weight_mean + g.opacity_factors.clamp_min(LEAST_WEIGHT).log()
    shown, larger = shown_members(faded, g.log_weight_std, seen.depths, camera)
    colors = eval_sh_colors(g.sh0 + larger[:, None] * g.sh0_log_weight_cov, g.shN, _directions(g.means, camera), degree)
    # 1 - (1 - share) ** covers, and with the layers that are left.
    layers = g.covers * torch.log1p(-shares)
    whole, thinned = (
        g.opacity_factors * g.opacity_logits.sigmoid() * -torch.expm1(layers * left) for left in (1.0, shown)
    )
    # What the rasterizer cuts off this splat itself has been counted with its members.
    drawn = torch.minimum(whole, thinned + ALPHA_MIN)
    opacities = torch.where(seen.valid & (shown > 0), drawn, 0)
    found = Splats(*(t.to(parts[0].means) for t in (seen.means_px, seen.conics, seen.depths, colors, opacities)))
    if before is None:
        return found
    return Splats(*(torch.cat([getattr(before, name), getattr(found, name)]) for name in SPLAT_TENSORS))


def _joined(parts: Sequence[MergedGaussians]) -> MergedGaussians:
    """All parts together, in float64, with factors: differences of numbers that are nearly equal are taken."""
    ones = torch.ones_like
    whole = [p if p.opacity_factors is not None else p._replace(opacity_factors=ones(p.covers)) for p in parts]
    return MergedGaussians(*(torch.cat(column).double() for column in zip(*whole, strict=True)))  # type: ignore[type-var]


def _directions(means: Float[Tensor, "n 3"], camera: Camera) -> Float[Tensor, "n 3"]:
    """From the camera to each place."""
    if camera.model != "pinhole":
        return torch.from_numpy(camera.forward.astype(np.float32)).to(means).expand(len(means), 3)
    center = torch.from_numpy(camera.position.astype(np.float32)).to(means)
    return torch.nn.functional.normalize(means - center, dim=-1)


def shown_members(
    log_weight_mean: Float[Tensor, " n"], log_weight_std: Float[Tensor, " n"], depths: Float[Tensor, " n"],
    camera: Camera,
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:  # fmt: skip
    """How much of what the members of merged Gaussians cover would be drawn in a view, if they were drawn themselves;
    and by how much the logarithms of their weights are larger than those of all, in parts of their variance.

    A member of weight w (opacity times area) that is smaller than a pixel has an alpha of w / (0.3 p²) at its center,
    where p is the size of a pixel there; nothing is drawn below `ALPHA_MIN`. Of what it covers there is left
    1 - t / w with t = `ALPHA_MIN` 0.3 p², nothing where w < t. The logarithms of weights are taken for normally
    distributed, with mean m and standard deviation s: the mean of max(0, 1 - t / w) is then N(d) - c with
    c = t exp(s² / 2 - m) N(d - s), d = (m - log t) / s, N the standard normal distribution. Right to 0.002. The mean of
    (log w - m) / s² over what is drawn is c / (N(d) - c).
    """
    pixels = torch.ones_like(depths) if camera.model == "orthographic" else depths**2
    least = (ALPHA_MIN * DILATION_PX2 / (camera.fx * camera.fy) * pixels).clamp_min(LEAST_WEIGHT).log()
    std = log_weight_std.clamp(*LOG_STDS)
    below = least - log_weight_mean
    distance = (-below / std).clamp_min(-MAX_STDS)
    # Far down the slope one is huge and the other tiny.
    cut = (below + std**2 / 2 + torch.special.log_ndtr(distance - std)).exp()
    shown = (torch.special.ndtr(distance) - cut).clamp(0, 1)
    larger = torch.minimum(cut / shown.clamp_min(LEAST_WEIGHT), MAX_STDS / std)
    return torch.where(distance > -MAX_STDS, shown, 0), larger
