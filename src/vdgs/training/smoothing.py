"""What people see of the progress: the loss and the PSNR of training views, smoothed; of a block, of the parts of
views that it draws."""

from __future__ import annotations

import math

from jaxtyping import Float, UInt8
from torch import Tensor

#: How much of the value before is kept at each step.
KEEP_LOSS, KEEP_PSNR = 0.98, 0.9


def smoothed(before: float, value: float, keep: float) -> float:
    """The exponential mean after one more value; NaN before the first."""
    return value if math.isnan(before) else keep * before + (1 - keep) * value


def psnr_of(
    image: Float[Tensor, "h w 3"], target: UInt8[Tensor, "h w 3"], mask: UInt8[Tensor, "h w"] | None
) -> float | None:
    """PSNR of a training view in dB; None where the mask keeps nothing."""
    squared = (image.clamp(0, 1) - target.float() / 255.0) ** 2
    counted = squared if mask is None else squared[mask > 0]
    return -10.0 * math.log10(max(float(counted.mean()), 1e-10)) if counted.numel() else None
