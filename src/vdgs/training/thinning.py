"""Gaussians left out at random where few cameras look, so that none may lean on what a single one of them shows.

A place that few photographs show is learnt by heart: its Gaussians fit together from those few sides only. With some of
them missing in every step, the others must each be right by themselves (dropout; for Gaussian splatting: Park et al.,
DropGaussian, CVPR 2025, who leave out the same share everywhere; the share by V is ours).
"""

from __future__ import annotations

from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.types import AnchorSplats


def thinned(splats: AnchorSplats, missing: Float[Tensor, " v"], offsets: int, seed: int) -> AnchorSplats:
    """The splats of a view without those that are left out: of each of the v visible anchors with `offsets` offsets, a
    share `missing` on average. The seed decides which."""
    share = missing[splats.source.long() // offsets]
    # Drawn on the CPU: the same ones for any device.
    numbers = torch.rand(len(share), generator=torch.Generator().manual_seed(seed)).to(share.device)
    kept = (numbers >= share).nonzero()[:, 0]
    return AnchorSplats(**{field.name: getattr(splats, field.name)[kept] for field in fields(AnchorSplats)})
