"""From anchors and a camera to a picture: cull, decode, rasterize."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.kernels.constants import DILATION_PX2
from vdgs.kernels.gaussian_projection import area_shares
from vdgs.kernels.kernel_types import SPLAT_TENSORS, AnchorSplats, DecoderWeights, Raster, Splats, TrainingSplats
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.envmap import ray_directions, sample_envmap
from vdgs.model.levels import pixel_sizes
from vdgs.model.local_exposure import apply_departures


@runtime_checkable
class LodDrawable(Protocol):
    """A scene in levels of detail (`model.lod_scene`)."""

    @property
    def background(self) -> tuple[float, float, float]: ...

    @property
    def envmap(self) -> Float[Tensor, "rows columns 3"] | None: ...

    def view_splats(self, camera: Camera, image_index: int | None = None) -> tuple[Int64[Tensor, " m"], Splats]: ...

    def without_aliasing(self, pixel: float) -> LodDrawable: ...


#: What can be drawn.
Drawable = AnchorModel | LodDrawable


@dataclass(frozen=True, eq=False)
class Antialiased:
    """A model seen without aliasing from farther away than its photographs were taken. `render` and its kin take it
    wherever they take a model.

    Each splat is drawn with a blur of 0.3 px². A model has learnt the blur of the pixels of its photographs; larger
    pixels enlarge what it shows, so that the nearest splats hide the others. Splats become more transparent here by as
    much as they grow (Mip-Splatting, eq. 9; gsplat's `rasterize_mode="antialiased"`), but for the learnt part of the
    blur: of what is as far away as the scene is from the cameras of the photographs, or nearer, no bit changes.
    """

    model: AnchorModel
    #: What a pixel of the photographs shows of the scene, in units of the ground frame
    #: (`captures.camera_height.pixel_at_camera_height`). At least the model's own `photograph_pixel` counts.
    pixel: float

    @property
    def background(self) -> tuple[float, float, float]:
        return self.model.background

    @property
    def envmap(self) -> Float[Tensor, "rows columns 3"] | None:
        return self.model.envmap

    def view_splats(self, camera: Camera, image_index: int | None = None) -> tuple[Int64[Tensor, " m"], Splats]:
        """The splats of a view, and the anchor or place that each is of."""
        rows, splats = view_splats(self.model, camera, image_index)
        return rows, compensated_splats(splats, camera, max(self.pixel, self.model.photograph_pixel))

    def without_aliasing(self, pixel: float) -> LodDrawable:
        return Antialiased(self.model, pixel)


def without_aliasing(scene: Drawable, pixel: float) -> LodDrawable:
    """A scene seen without aliasing: see `Antialiased`."""
    return Antialiased(scene, pixel) if isinstance(scene, AnchorModel) else scene.without_aliasing(pixel)


def compensated_splats(splats: Splats, camera: Camera, pixel: float) -> Splats:
    """The splats of a view as much more transparent as their blur enlarges them, but for what they have learnt of it:
    that of pixels which show so much of the scene. 0: nothing."""
    depths = splats.depths if camera.model == "pinhole" else torch.ones_like(splats.depths)
    learnt = (pixel * max(camera.fx, camera.fy) / depths).square()
    shares = area_shares(splats.conics, DILATION_PX2 * (1 - learnt).clamp(min=0))
    # What is not drawn may have any depth.
    return replace(splats, opacities=torch.where(splats.opacities > 0, splats.opacities * shares, 0.0))


def decode_anchors(
    anchors: Anchors, rows: Int64[Tensor, " v"], weights: DecoderWeights, camera: Camera
) -> AnchorSplats:
    """Splats of the anchors of the given rows, as this camera sees them."""
    return get_backend(anchors.positions.device).decode(
        anchors.positions, anchors.features, anchors.offsets, anchors.log_scales, weights, camera, rows
    )


def decode_anchors_for_training(
    anchors: Anchors, rows: Int64[Tensor, " v"], weights: DecoderWeights, camera: Camera
) -> TrainingSplats:
    """As much of `decode_anchors` as a training step asks for; on a card, not in the order of the rows."""
    return get_backend(anchors.positions.device).decode_for_training(
        anchors.positions, anchors.features, anchors.offsets, anchors.log_scales, weights, camera, rows
    )


def cull_anchors(anchors: Anchors, camera: Camera) -> Int64[Tensor, " v"]:
    """Rows of the anchors that may touch a view and have a level that it draws, ascending."""
    rows = get_backend(anchors.positions.device).cull(anchors.positions, anchors.log_scales, camera)
    if anchors.max_pixels is None:
        return rows
    return rows[pixel_sizes(anchors.positions[rows], camera) <= anchors.max_pixels[rows]]


def decode_view(
    model: AnchorModel, camera: Camera, image_index: int | None = None
) -> tuple[Int64[Tensor, " v"], AnchorSplats]:
    """The rows that may touch a view and their splats, each anchor by its own decoder; `source` counts rows.
    `image_index` as in `render`."""
    camera = replace(camera, photograph_pixel=model.photograph_pixel)
    rows = cull_anchors(model.anchors, camera)
    spans = model.decoder_ranges()
    starts = rows.new_tensor([first for first, _, _ in spans] + [len(model.anchors)])
    bounds = torch.searchsorted(rows, starts).tolist()
    shown = [
        (first, last, decoder)
        for (first, last), (_, _, decoder) in zip(pairwise(bounds), spans, strict=True) if first < last
    ] or [(0, 0, model.decoder)]  # fmt: skip
    parts = [
        (first, decode_anchors(model.anchors, rows[first:last], decoder.weights_for_image(image_index), camera))
        for first, last, decoder in shown
    ]
    k, splats = model.anchors.offsets.shape[1], parts[0][1]
    if len(parts) > 1:
        named = {name: torch.cat([getattr(each, name) for _, each in parts]) for name in (*SPLAT_TENSORS, "volumes")}
        splats = AnchorSplats(**named, source=torch.cat([each.source + first * k for first, each in parts]))
    if model.anchors.opacity_factors is not None:
        factors = model.anchors.opacity_factors[rows].flatten()[splats.source.long()]
        splats = replace(splats, opacities=splats.opacities * factors)
    if model.local_exposure is not None:
        departures = model.local_exposure.at(model.anchors.positions.index_select(0, rows))
        anchor = splats.source.div(k, rounding_mode="floor")
        splats = replace(splats, colors=apply_departures(splats.colors, departures, anchor))
    return rows, splats


def rasterize_splats(splats: Splats, camera: Camera, background: Float[Tensor, "3"], depth: bool = False) -> Raster:
    """Splats to image, alpha and (on request) expected depth, differentiable, and median depth, which is not."""
    kernels = get_backend(splats.means_px.device)
    return kernels.rasterize(splats, background, camera.width, camera.height, depth=depth)


def view_splats(model: Drawable, camera: Camera, image_index: int | None = None) -> tuple[Int64[Tensor, " m"], Splats]:
    """The splats of a view, and the anchor that each is of (of a scene in levels of detail, the place)."""
    if not isinstance(model, AnchorModel):
        return model.view_splats(camera, image_index)
    rows, splats = decode_view(model, camera, image_index)
    return rows[splats.source.long() // model.anchors.offsets.shape[1]], splats


@torch.no_grad()
def render(
    model: Drawable,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = None,
    depth: bool = False,
    image_index: int | None = None,
) -> Raster:
    """One view of a model: image [h, w, 3] (not clamped), alpha [h, w], expected and median depth [h, w] or None.

    `background` replaces the model's own, its environment map too. `image_index` selects the appearance of a training
    image; None: the mean.
    """
    find = decode_view if isinstance(model, AnchorModel) else view_splats
    _, splats = find(model, camera, image_index)  # type: ignore[arg-type]
    plain = splats.means_px.new_tensor(background or model.background)
    raster = rasterize_splats(splats, camera, plain, depth)
    if background is not None or (behind := background_image(model, camera)) is None:
        return raster
    return raster._replace(image=raster.image + (1 - raster.alpha)[..., None] * (behind - plain))


def background_image(model: Drawable, camera: Camera) -> Float[Tensor, "h w 3"] | None:
    """What the environment map of a model shows in a view; None where its plain color is shown: without a map, and in
    maps of the ground."""
    if model.envmap is None or camera.model == "orthographic":
        return None
    return sample_envmap(model.envmap, ray_directions(camera, model.envmap.device))


@torch.no_grad()
def render_scalar(
    model: Drawable, values: Float[Tensor, " n"], camera: Camera
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """A value per anchor blended in place of its color, over 0, and alpha."""
    rows, splats = view_splats(model, camera)
    of_splat = values.to(rows.device)[rows].float()
    gray = replace(splats, colors=of_splat[:, None].expand(-1, 3).contiguous())
    painted = rasterize_splats(gray, camera, splats.means_px.new_zeros(3))
    return painted.image[..., 0], painted.alpha


def render_scalar_map(model: Drawable, values: Float[Tensor, " n"], camera: Camera) -> Float[Tensor, "h w"]:
    """A value per anchor as a map: the alpha-weighted mean at each pixel, NaN where alpha is at most one half."""
    scale = float(values.max().clamp(min=1)) if len(values) else 1.0
    painted, alpha = render_scalar(model, values / scale, camera)
    value = painted / alpha.clamp(min=1e-6) * scale
    return torch.where(alpha > 0.5, value, torch.full_like(value, float("nan")))
