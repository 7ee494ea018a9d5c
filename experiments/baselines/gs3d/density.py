"""Where explicit Gaussians are added and removed: adaptive control of density (3DGS section 5.2). Pure functions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.kernels.rotations import rotation_matrices
from vdgs.model.gaussians import Gaussians

#: A Gaussian is split into so many (3DGS section 5.2).
SPLIT_COUNT = 2


@dataclass(frozen=True)
class DensityConfig:
    """3DGS section 5.2; "program": the authors' published program says what the paper leaves open."""

    interval: int = 100
    """Iterations between two decisions (section 5.2)."""
    start: int = 500
    """The first decision comes after so many iterations (program)."""
    until: float = 0.5
    """Decisions come before this share of the iterations is made (program: before the 15 000th of 30 000)."""
    threshold: float = 2e-4
    """tau_pos: mean norm of dL/d(mean) in NDC units from which a Gaussian is cloned or split (section 5.2)."""
    dense: float = 0.01
    """Gaussians larger than this share of the scene's extent are split, the others cloned (program)."""
    shrink: float = 1.6
    """phi: the parts of a split Gaussian are so many times smaller (section 5.2)."""
    prune_opacity: float = 0.005
    """epsilon_alpha: less opaque Gaussians go (section 5.2; value: program)."""
    prune_size: float = 0.1
    """Gaussians larger than this share of the extent go, once opacities were reset (section 5.2; value: program)."""
    reset_interval: int = 3000
    """N: iterations between two resets of all opacities, as long as there are decisions (section 5.2; program)."""
    reset_opacity: float = 0.01
    """Opacities are at most this after a reset (section 5.2: "close to zero"; value: program)."""
    max_gaussians: int = 0
    """No growth beyond so many, those of the largest gradients first; 0 for no limit (choice)."""


@dataclass(frozen=True)
class DensificationResult:
    """What one decision does: first append `added`, then keep `kept` of all n + a."""

    added: Gaussians
    kept: Bool[Tensor, " n_and_a"]
    cloned: int
    split: int
    #: Too faint or too large; those that were replaced by their parts are not counted.
    pruned: int


def max_scales(gaussians: Gaussians) -> Float[Tensor, " n"]:
    """The largest standard deviation of each Gaussian."""
    return gaussians.log_scales.max(dim=1).values.exp()


def adaptive_density_control(
    gaussians: Gaussians,
    gradient: Float[Tensor, " n"],
    extent: float,
    config: DensityConfig,
    generator: torch.Generator,
    *,
    prune_large: bool,
) -> DensificationResult:
    """One decision. `gradient` is the mean norm over the views that a Gaussian was visible in, `extent` the size of
    the scene in units of the ground frame. Clones stand where their original stands (program: it is the moments of
    Adam that part them)."""
    asks = _within_limit(gradient, gradient >= config.threshold, config.max_gaussians)
    large = max_scales(gaussians) > config.dense * extent
    clones, parents = asks & ~large, asks & large
    added = gaussians.select(clones).concat(split_gaussians(gaussians.select(parents), config.shrink, generator))
    everything = gaussians.concat(added)
    unfit = everything.opacity_logits.sigmoid() < config.prune_opacity
    if prune_large:
        unfit |= max_scales(everything) > config.prune_size * extent
    replaced = torch.cat([parents, parents.new_zeros(len(added))])
    return DensificationResult(
        added, ~(unfit | replaced), int(clones.sum()), int(parents.sum()), int((unfit & ~replaced).sum())
    )  # fmt: skip


def split_gaussians(parents: Gaussians, shrink: float, generator: torch.Generator) -> Gaussians:
    """SPLIT_COUNT parts for each of p parents, all first parts before all second ones: their means are drawn from the
    parent's own distribution, their scales divided by `shrink`, everything else is the parent's."""
    parts = parents.select(torch.arange(len(parents), device=parents.means.device).repeat(SPLIT_COUNT))
    # Drawn on the CPU: the same numbers for any device.
    along_axes = torch.randn(len(parts), 3, generator=generator).to(parts.means) * parts.log_scales.exp()
    moved = (rotation_matrices(parts.quaternions) @ along_axes[:, :, None])[:, :, 0]
    return replace(parts, means=parts.means + moved, log_scales=parts.log_scales - math.log(shrink))


def cap_opacity_logits(logits: Float[Tensor, " n"], opacity: float) -> Float[Tensor, " n"]:
    """Opacities (before the sigmoid) of at most `opacity`."""
    return logits.clamp(max=math.log(opacity / (1 - opacity)))


def _within_limit(gradient: Float[Tensor, " n"], asks: Bool[Tensor, " n"], limit: int) -> Bool[Tensor, " n"]:
    """Of those that ask, as many as there is room for: clone and split add one Gaussian each."""
    room = max(limit - len(gradient), 0)
    if not limit or int(asks.sum()) <= room:
        return asks
    strongest = torch.where(asks, gradient, -torch.ones_like(gradient)).argsort(descending=True, stable=True)
    return torch.zeros_like(asks).index_fill_(0, strongest[:room], True)
