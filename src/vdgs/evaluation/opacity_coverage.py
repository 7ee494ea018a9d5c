"""Whether a model is opaque where photographs show ground.

A model may leave ground half transparent and borrow the missing color from its background. PSNR of test views from
nearby does not show that. Measured are the share of covered pixels that is opaque, PSNR over them before several
backgrounds, and the number of splats larger than the image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from vdgs.evaluation.by_visibility import mean_or_none
from vdgs.evaluation.metrics import psnr_from_mse, squared_error, to_8bit
from vdgs.evaluation.view_exposures import apply_exposure_numpy
from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.kernel_types import Raster, Splats
from vdgs.model.ground import below_horizon
from vdgs.visibility.visibility_counts import count_visibility

#: At least this opaque, a pixel counts as solid.
OPAQUE_ALPHA = 0.95
#: PSNR over seen pixels before the model's own background, a black and a white one.
COVERED_PSNR_KEYS = ("psnr_covered_own_background", "psnr_covered_black", "psnr_covered_white")

RgbColor = tuple[float, float, float]
_BLACK: RgbColor = (0.0, 0.0, 0.0)
_WHITE: RgbColor = (1.0, 1.0, 1.0)
#: A pixel is seen if at least so many training cameras see the place that it shows: fewer cannot fix a depth well.
MIN_SEEN_BY = 3
#: At least this opaque, a pixel shows something that may stand before the sky.
MIN_ALPHA = 0.5


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """A view as it came from the renderer, before rounding."""

    image: Float[np.ndarray, "h w 3"]
    #: None: the renderer does not say.
    alpha: Float[np.ndarray, "h w"] | None
    #: What is behind the model in `image`, a color or one for each pixel; None: not known.
    background: RgbColor | Float[np.ndarray, "*pixels 3"] | None = None

    def with_exposure(self, exposure: Float[Tensor, "3 4"]) -> RenderedImage:
        """The view with the color model of a photograph: all colors, the background's too. They may leave [0, 1]."""
        background = None if self.background is None else apply_exposure_numpy(np.asarray(self.background), exposure)
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

    A splat ends where its alpha falls to ALPHA_MIN: at sqrt(2 ln(opacity / ALPHA_MIN)) standard deviations. Its center
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
    """Splats larger than the image over all views, and the view with most of them."""
    known = [row for row in rows if row["oversized_splats"] is not None]
    worst = max(known, key=lambda row: row["oversized_splats"], default=None)
    return {
        "oversized_splats": sum(row["oversized_splats"] for row in known) if known else None,
        "max_oversized_splats": worst["oversized_splats"] if worst else None,
        "max_oversized_splats_view": worst["name"] if worst and worst["oversized_splats"] else None,
    }


def coverage_map(
    draw_depth: Callable[[Camera], Raster], cameras: Sequence[Camera]
) -> Callable[[Camera], Bool[np.ndarray, "h w"]]:
    """Camera of a view -> which of its pixels show a place that lies in the pictures of at least `MIN_SEEN_BY` of
    `cameras` (the training cameras; without occlusion, as in V).

    A solid pixel shows the point at which the model behind `draw_depth` (a render with depth) is half opaque. All other
    pixels continue the depth of the nearest solid ones, down to the ground but not up into the sky: beyond what cameras
    cover, half transparent splats lie at any depth (measured on a generated town). V drawn from anchors would not do:
    at the edge of what cameras cover, splats reach far beyond their anchors.

    A floater of that model close before the view lies where few cameras look: what it covers is not seen.
    """

    def seen(camera: Camera) -> Bool[np.ndarray, "h w"]:
        with torch.inference_mode():
            raster = draw_depth(camera)
        assert raster.median_depth is not None
        alpha = raster.alpha.cpu().numpy()
        drawn, solid = alpha >= MIN_ALPHA, alpha >= OPAQUE_ALPHA
        if not drawn.any():
            return drawn
        # A scene that is a ghost has no solid pixel: what it half shows has to answer for it.
        depth = fill_depth(raster.median_depth.cpu().numpy(), solid if solid.any() else drawn)
        places = torch.from_numpy(camera.unproject(depth).reshape(-1, 3))
        held = count_visibility(places, cameras).numpy().reshape(drawn.shape) >= MIN_SEEN_BY
        return held & (drawn | below_horizon(camera, *drawn.shape))

    return seen


def fill_depth(depth: Float[np.ndarray, "h w"], is_drawn: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth where something is drawn, elsewhere that of the nearest such pixel. At least one is drawn."""
    row, column = distance_transform_edt(~is_drawn, return_distances=False, return_indices=True)
    return depth[row, column]
