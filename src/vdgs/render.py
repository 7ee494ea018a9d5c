"""From anchors and a camera to a picture: cull, decode, rasterise."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.anchors import AnchorModel, Anchors
from vdgs.cameras import Camera
from vdgs.kernels import native as kernels
from vdgs.kernels.decode_types import DecoderWeights, Splats
from vdgs.kernels.types import Raster


def decode_rows(anchors: Anchors, rows: Int64[Tensor, " v"], weights: DecoderWeights, camera: Camera) -> Splats:
    """Splats of the anchors of the given rows, as this camera sees them."""
    return kernels.decode(
        anchors.positions, anchors.features, anchors.offsets, anchors.log_scales, weights, camera, rows
    )


def visible_rows(anchors: Anchors, camera: Camera) -> Int64[Tensor, " v"]:
    """Rows of the anchors that may touch a view, ascending."""
    return kernels.cull(anchors.positions, anchors.log_scales, camera)


def draw(splats: Splats, camera: Camera, background: Float[Tensor, "3"], depth: bool = False) -> Raster:
    """Splats to image, alpha and (on request) expected depth; differentiable."""
    return kernels.rasterise(
        splats.means_px, splats.conics, splats.colours, splats.opacities, splats.depths,
        background, camera.width, camera.height, depth=depth,
    )  # fmt: skip


@torch.no_grad()
def render(
    model: AnchorModel,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = None,
    depth: bool = False,
    image: int | None = None,
) -> Raster:
    """One view of a model: image [h, w, 3] (not clamped), alpha [h, w], depth [h, w] or None.

    `background` replaces the model's own. `image` is the index of a training image whose appearance to use;
    None takes the mean appearance.
    """
    rows = visible_rows(model.anchors, camera)
    splats = decode_rows(model.anchors, rows, model.decoder.for_image(image), camera)
    return draw(splats, camera, torch.tensor(background or model.background), depth)


@torch.no_grad()
def render_values(model: AnchorModel, values: Float[Tensor, " n"], camera: Camera) -> Float[Tensor, "h w"]:
    """A value per anchor drawn as a map: the alpha-weighted mean at each pixel, NaN where nothing is drawn.

    Used for visibility maps (V at each pixel).
    """
    rows = visible_rows(model.anchors, camera)
    splats = decode_rows(model.anchors, rows, model.decoder.for_image(None), camera)
    k = model.anchors.offsets.shape[1]
    scale = float(values.max().clamp(min=1)) if len(values) else 1.0
    of_splat = values[rows][splats.source.long() // k].float() / scale
    painted = kernels.rasterise(
        splats.means_px, splats.conics, of_splat[:, None].expand(-1, 3).contiguous(), splats.opacities,
        splats.depths, torch.zeros(3), camera.width, camera.height,
    )  # fmt: skip
    value = painted.image[..., 0] / painted.alpha.clamp(min=1e-6) * scale
    return torch.where(painted.alpha > 0.5, value, torch.full_like(value, float("nan")))
