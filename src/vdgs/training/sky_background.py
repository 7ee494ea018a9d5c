"""What a training step shows behind the anchors where a photograph shows sky: the environment map.

Elsewhere a random color stays, so that ground cannot borrow its color from the map. The map is composed with the
picture outside the rasterizer: a pixel is C + T (sky - b) + T b with the plain background b and transmittance T. Where
nothing but sky shows, splats of its color would change nothing: alpha itself costs there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.captures.scene_points import scene_points
from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import RasterGradients
from vdgs.kernels.transfer import upload
from vdgs.model.decoder import Decoder
from vdgs.model.envmap import ray_directions, sample_envmap
from vdgs.model.initialization.sky import Skyline, find_skylines, initial_envmap, sky_above
from vdgs.model.initialization.sky_masks import SkyMask, find_sky_masks
from vdgs.training.target import TrainingTarget
from vdgs.training.training_state import TrainingImages, TrainingProblem
from vdgs.training.training_step import RenderedTrainingView

#: Sparse points by which skylines are found.
_MAX_POINTS = 20_000


#: The map moves by pixels alone of which it makes at least this share: what stands before it has errors of its own.
MIN_SHOWN = 0.5
#: The loss of alpha in pixels of empty sky, in the unit of the loss of a photograph (choice).
EMPTY_WEIGHT = 0.1


def view_skylines(capture: Capture, views: Sequence[View]) -> tuple[tuple[Skyline | None, ...], bool]:
    """The skylines of views of a capture, and whether they show sky, as `find_skylines`."""
    return find_skylines(lambda: scene_points(capture, _MAX_POINTS), [view.camera for view in views])


def view_sky_masks(
    capture: Capture, images: TrainingImages, config: TrainConfig, skylines: Sequence[Skyline | None],
    envmap: Tensor | None, background: tuple[float, float, float],
) -> tuple[SkyMask | None, ...]:  # fmt: skip
    """The sky of the views of `images`, training images of a capture; without a map `envmap` by the one that
    photographs make of what is above their skylines."""
    factor, cameras = min(factor for _, factor in config.resolution_schedule), view_cameras(images, len(skylines))
    if envmap is None:
        above = [None if skyline is None else partial(sky_above, skyline) for skyline in skylines]
        envmap = photographed_envmap(images, config, above, background)
    points = scene_points(capture, _MAX_POINTS)
    return find_sky_masks(lambda index: images.get(index, factor)[0], cameras, skylines, envmap, points)


def photographed_envmap(
    images: TrainingImages, config: TrainConfig, sky: Sequence[Callable[[Camera], Bool[Tensor, "h w"]] | None],
    background: tuple[float, float, float],
) -> Float[Tensor, "rows columns 3"]:  # fmt: skip
    """`initial_envmap` of training images, in the smallest size that they are trained in."""
    factor = max(factor for _, factor in config.resolution_schedule)

    def read(index: int) -> tuple[Tensor, Tensor | None, Camera]:
        return *images.get(index, factor), images.camera(index, factor)

    return initial_envmap(read, sky, view_cameras(images, len(sky)), background)


def view_cameras(images: TrainingImages, count: int) -> list[Camera]:
    """The cameras of the first `count` training images."""
    return [images.camera(index) for index in range(count)]


def with_sky(
    drawn: RenderedTrainingView, stage: TrainingProblem, view: int, decoder: Decoder, target: TrainingTarget,
    background: Float[Tensor, "3"],
) -> RenderedTrainingView:  # fmt: skip
    """The view with the environment map of the decoder, where it has one and the view shows sky. Going backward leaves
    in the `.grad` of the map how the loss changes with each of its cells: the mean over the pixels that count and show
    the cell, in the loss of one pixel. Cells that show for less than a pixel count as if it were one: Adam would move
    them as fast as the others, away from what no pixel holds. In pixels of empty sky the mean of alpha is a loss, of
    which the gradient is left too, but which the loss of the step does not show."""
    envmap, sky_mask = decoder.envmap, None if stage.sky_masks is None else stage.sky_masks[view]
    if envmap is None or sky_mask is None:
        return drawn
    is_sky = sky_mask.sky_at(target.camera)
    # Rows without sky cost nothing more.
    shows = is_sky.any(dim=1).nonzero()[:, 0].tolist()
    if not shows:
        return drawn
    part = slice(shows[0], shows[-1] + 1)
    directions = ray_directions(target.camera, stage.device)[part]
    is_sky = upload(is_sky[part], stage.device)[..., None]
    empty = upload(sky_mask.empty_at(target.camera)[part], stage.device).float()
    if target.mask is not None:
        empty *= target.mask[part] > 0
    empty *= EMPTY_WEIGHT * stage.loss_weight / max(target.counted_pixels, 1)
    through = (1 - drawn.raster.alpha[part])[..., None] * is_sky
    difference = (sample_envmap(envmap.detach(), directions) - background) * is_sky
    composed = drawn.image.clone()
    composed[part] += through * difference

    def pullback(
        image: Tensor | None, alpha: Tensor | None = None, depth: Tensor | None = None,
        out: tuple[Tensor, Tensor] | None = None, count: int | None = None,
    ) -> RasterGradients:  # fmt: skip
        if image is not None:
            alpha = torch.zeros_like(drawn.raster.alpha) if alpha is None else alpha.clone()
            alpha[part] += empty - (image[part] * difference).sum(-1)
            if envmap.requires_grad:
                shown = through * (through >= MIN_SHOWN)
                if target.mask is not None:
                    shown *= target.mask[part, :, None] > 0
                by_map = _spread(torch.cat([image[part] * shown, shown], dim=-1), directions, envmap)
                envmap.grad = by_map[..., :3] * target.counted_pixels / by_map[..., 3:].clamp(min=1)
        return drawn.pullback(image, alpha, depth, out=out, count=count)

    return replace(drawn, image=composed, pullback=pullback)


def _spread(
    by_pixel: Float[Tensor, "h w c"], directions: Float[Tensor, "h w 3"], envmap: Float[Tensor, "rows columns 3"]
) -> Float[Tensor, "rows columns c"]:
    """The transpose of `sample_envmap`, for any number of channels: what pixels say of each cell of a map."""
    cells = envmap.new_zeros(*envmap.shape[:2], by_pixel.shape[-1], requires_grad=True)
    with torch.enable_grad():
        (found,) = torch.autograd.grad((sample_envmap(cells, directions) * by_pixel).sum(), [cells])
    return found
