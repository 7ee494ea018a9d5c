"""Whether a model is opaque where photographs show ground.

A model may leave ground half transparent and borrow what is missing from the colour of its background. On test views
that look at the same ground from nearby, PSNR does not notice; seen from elsewhere, or before another background, the
ground is a veil. So it is measured what share of the pixels that training cameras see is opaque, how PSNR over them
changes with the background, and how many splats are larger than the picture: of such veils are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vdgs.evaluation.by_visibility import mean_or_none
from vdgs.evaluation.metrics import psnr_from_mse, squared_error, to_8bit
from vdgs.evaluation.view_exposures import apply_exposure_numpy
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.kernel_types import Splats

#: At least this opaque, a pixel counts as solid.
OPAQUE_ALPHA = 0.95
#: PSNR over seen pixels before the model's own background, a black and a white one.
COVERED_PSNR_KEYS = ("psnr_covered_own_background", "psnr_covered_black", "psnr_covered_white")

RgbColor = tuple[float, float, float]
_BLACK: RgbColor = (0.0, 0.0, 0.0)
_WHITE: RgbColor = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """A view as it came from the renderer, before rounding."""

    image: Float[np.ndarray, "h w 3"]
    #: None: the renderer does not say.
    alpha: Float[np.ndarray, "h w"] | None
    #: What is behind the model in `image`; None: not known.
    background: RgbColor | None = None

    def with_exposure(self, exposure: Float[Tensor, "3 4"]) -> RenderedImage:
        """The view with the colour model of a photograph: all colours, the background's too. They may leave [0, 1]."""
        background = self.background
        if background is not None:
            red, green, blue = apply_exposure_numpy(np.array(background), exposure).tolist()
            background = red, green, blue
        return RenderedImage(apply_exposure_numpy(self.image, exposure), self.alpha, background)

    def over_background(self, color: RgbColor) -> UInt8[np.ndarray, "h w 3"] | None:
        """The picture in 8 bits with another background; None where alpha or its own background is not known."""
        if self.alpha is None or self.background is None:
            return None
        # In the precision of the image: where alpha is 1, the bits stay, and with them what is rounded up or down.
        change = np.subtract(color, self.background).astype(self.image.dtype)
        return to_8bit(self.image + (1.0 - self.alpha)[..., None] * change)


def measure_opacity_coverage(
    rendered: RenderedImage, reference: UInt8[np.ndarray, "h w 3"], covered: Bool[np.ndarray, "h w"] | None
) -> dict[str, float | None]:
    """The figures of one view; None where alpha, the background or the seen pixels are not known, or there are none."""
    row: dict[str, float | None] = {"covered_pixels": None, "opaque_pixels": None, "opacity_coverage": None}
    row |= dict.fromkeys(COVERED_PSNR_KEYS)
    if covered is None:
        return row
    count = row["covered_pixels"] = int(np.count_nonzero(covered))
    if rendered.alpha is not None:
        solid = row["opaque_pixels"] = int(np.count_nonzero(rendered.alpha[covered] >= OPAQUE_ALPHA))
        row["opacity_coverage"] = solid / count if count else None
    pictures = to_8bit(rendered.image), rendered.over_background(_BLACK), rendered.over_background(_WHITE)
    for name, picture in zip(COVERED_PSNR_KEYS, pictures, strict=True):
        if picture is not None and count:
            row[name] = psnr_from_mse(float(squared_error(picture, reference)[covered].mean()))
    return row


def summarize_opacity_coverage(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """The figures of all views, from the rows of each: shares of all seen pixels, means of PSNR over the views."""
    known = [row for row in rows if row["opaque_pixels"] is not None]
    seen = sum(row["covered_pixels"] for row in known)
    solid = sum(row["opaque_pixels"] for row in known)
    result = (
        {"covered_pixels": seen, "opacity_coverage": solid / seen}
        if seen
        else {"covered_pixels": None, "opacity_coverage": None}
    )
    return result | {name: mean_or_none([row[name] for row in rows]) for name in COVERED_PSNR_KEYS}


def count_oversized_splats(splats: Splats, width: int, height: int) -> int:
    """How many splats are drawn into a picture (pixels) whose longer side their major diameter exceeds.

    A splat ends where its alpha falls to ALPHA_MIN: at sqrt(2 ln(opacity / ALPHA_MIN)) standard deviations. Its centre
    may lie anywhere, but the box around it reaches the picture.
    """
    a, b, c = splats.conics.double().unbind(dim=1)
    opacities, centers = splats.opacities.double(), splats.means_px.double()
    determinant = a * c - b * b
    drawn = (a > 0) & (c > 0) & (determinant > 0) & (opacities >= ALPHA_MIN)
    level = 2.0 * torch.log(opacities / ALPHA_MIN)
    # The inverse conic is the covariance: its diagonal is (c, a) over the determinant, its larger eigenvalue the
    # conic's larger one over the determinant (its smaller one would be lost in a difference for a needle).
    larger = (a + c) / 2 + torch.hypot((a - c) / 2, b)
    diameter = 2.0 * torch.sqrt(level * larger / determinant)
    reach = torch.sqrt(level[:, None] * torch.stack([c, a], dim=1) / determinant[:, None])
    size = centers.new_tensor([width, height])
    touching = ((centers + reach > 0) & (centers - reach < size)).all(dim=1)
    return int((drawn & touching & (diameter > max(width, height))).sum())


def summarize_oversized_splats(rows: Sequence[Mapping[str, Any]]) -> dict[str, int | str | None]:
    """Splats larger than the picture over all views, and the view with most of them, from `oversized_splats` of each."""
    known = [row for row in rows if row["oversized_splats"] is not None]
    worst = max(known, key=lambda row: row["oversized_splats"], default=None)
    return {
        "oversized_splats": sum(row["oversized_splats"] for row in known) if known else None,
        "max_oversized_splats": worst["oversized_splats"] if worst else None,
        "max_oversized_splats_view": worst["name"] if worst and worst["oversized_splats"] else None,
    }
