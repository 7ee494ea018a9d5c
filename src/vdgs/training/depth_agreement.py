"""One depth for each pixel: what hangs before or behind the surface that a pixel shows is drawn towards it or fades.

The loss is |expected depth − alpha · median depth| in camera heights, a mean over the pixels that count; the median
depth stands still. Photographs look the same with splats spread in depth, views from elsewhere do not. (2DGS's depth
distortion sums over pairs of splats, which takes another pass.)
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from vdgs.config.method import TrainConfig
from vdgs.kernels.kernel_types import Raster

#: So many steps from one with this loss to the next, in which it weighs as much as in all of them together: depths cost
#: an eighth of a step.
EVERY = 2
#: Pixels less opaque than this have no surface.
MIN_ALPHA = 0.5
#: Below this difference (camera heights) the loss is quadratic.
SMOOTH_BELOW = 0.002


class DepthAgreement(NamedTuple):
    """The loss, and its gradients by alpha and expected depth."""

    loss: Float[Tensor, ""]
    alpha: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]


def is_agreement_due(config: TrainConfig, iteration: int) -> bool:
    """Whether iteration (from 0) compares depths."""
    return config.loss.depth_agreement > 0 and iteration % EVERY == 0


@torch.no_grad()
def depth_agreement(raster: Raster, camera_height: float, mask: UInt8[Tensor, "h w"] | None = None) -> DepthAgreement:
    """The loss of a picture drawn with depth, in units in which cameras are so high. Pixels where `mask` is zero do not
    count; with no pixel left, loss and gradients are 0."""
    assert raster.depth is not None
    assert raster.median_depth is not None
    shown = (raster.alpha > MIN_ALPHA) & (raster.median_depth > 0)
    count: int | Tensor = shown.numel()
    if mask is not None:
        shown &= mask > 0
        count = mask.count_nonzero().clamp(min=1)  # stays on the device: to read it would wait for a GPU
    median = raster.median_depth * shown
    apart = (raster.depth - raster.alpha * median).mul_(shown).div_(camera_height)
    # Huber's loss and its slope, s (apart - s d / 2) and s; in place, for each picture anew costs as much as the sum.
    slope = (apart / SMOOTH_BELOW).clamp_(-1, 1)
    loss = apart.sub_(slope, alpha=SMOOTH_BELOW / 2).mul_(slope).sum() / count
    slope.div_(count * camera_height)
    return DepthAgreement(loss, median.mul_(slope).neg_(), slope)
