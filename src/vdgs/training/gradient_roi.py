"""The part of a view that a block's splats reach: no other pixel can move them, so a step draws no more of it."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import ALPHA_MIN, SSIM_WINDOW_PX
from vdgs.kernels.kernel_types import Splats, TrainingSplats
from vdgs.training.crops import FULL_AREA_FRACTION, PixelBox
from vdgs.training.training_state import TrainingProblem
from vdgs.training.training_step import with_opacity_factors

#: A pixel is in windows of SSIM around others, which look as far again.
MARGIN_PX = SSIM_WINDOW_PX - 1
#: What rounding may hide of how far a splat reaches.
SLACK_PX = 1.0


def crop_to_gradient_support(
    stage: TrainingProblem,
    splats: TrainingSplats,
    camera: Camera,
    box: PixelBox,
    opacity_factors: Float[Tensor, " m"] | None = None,
) -> PixelBox:
    """The part of a box of a view, which `camera` shows, that gives the same gradients of a block's splats, with their
    opacities multiplied by factors, but for rounding. The means of the splats are shifted to pixels of the part, in
    place. On a GPU the whole box: computing the part would wait for the GPU."""
    frozen = stage.frozen_anchors
    if frozen is None or not len(frozen.anchors) or stage.device.type != "cpu":
        return box
    part = splat_roi(with_opacity_factors(splats, opacity_factors), camera)
    if part is None:
        return box
    left, top, right, bottom = part
    splats.means_px.sub_(splats.means_px.new_tensor([left, top]))
    return box[0] + left, box[1] + top, box[0] + right, box[1] + bottom


def splat_roi(splats: Splats, camera: Camera) -> PixelBox | None:
    """The part of an image that splats reach, with the margin of the loss; None: all, nearly all, or nothing."""
    reached = splat_bounds(splats, camera.width, camera.height)
    if reached is None:
        return None
    left, top, right, bottom = reached
    left, top = max(left - MARGIN_PX, 0), max(top - MARGIN_PX, 0)
    right, bottom = min(right + MARGIN_PX, camera.width), min(bottom + MARGIN_PX, camera.height)
    if (right - left) * (bottom - top) >= FULL_AREA_FRACTION * camera.width * camera.height:
        return None
    return left, top, right, bottom


@torch.no_grad()
def splat_bounds(splats: Splats, width: int, height: int) -> PixelBox | None:
    """The pixels of a picture in which splats may have an alpha of 1/255; None if there are none.

    On the ellipse a dx² + 2 b dx dy + c dy² = q, dx² reaches q c / (a c - b²). Of splats that are not drawn, because
    they are faint, not finite or not positive definite, that is NaN, which lies nowhere.
    """
    a, b, c = splats.conics.unbind(dim=1)
    # In double the products are exact: of a splat seen edge-on little else is left.
    determinant = a.double() * c - b.double().square()
    level = 2 * torch.log(splats.opacities / ALPHA_MIN)
    scale = (level / determinant).to(level.dtype)
    reach = torch.stack([c * scale, a * scale], dim=1).sqrt_().add_(SLACK_PX)
    low, high, size = splats.means_px - reach, splats.means_px + reach, reach.new_tensor([width, height])
    outside = ~((high > 0) & (low < size)).all(dim=1, keepdim=True)
    first = low.masked_fill_(outside, math.inf).amin(dim=0).floor().clamp(min=0) if len(low) else size
    if not bool((first < size).all()):
        return None
    last = torch.minimum(high.masked_fill_(outside, -math.inf).amax(dim=0).ceil(), size)
    (left, top), (right, bottom) = first.int().tolist(), last.int().tolist()
    return left, top, right, bottom
