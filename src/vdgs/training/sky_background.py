"""What a training step shows behind the anchors where a photograph looks above the scene: the environment map.

Below the skyline a random color stays, so that ground cannot borrow its color from the map. The map is composed with
the picture outside the rasterizer: a pixel is C + T (sky - b) + T b with the plain background b and transmittance T.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.captures.scene_points import scene_points
from vdgs.kernels.kernel_types import RasterGradients
from vdgs.model.decoder import Decoder
from vdgs.model.envmap import ray_directions, sample_envmap
from vdgs.model.initialization.sky import Skyline, above_skyline, find_skylines
from vdgs.training.target import TrainingTarget
from vdgs.training.training_state import TrainingProblem
from vdgs.training.training_step import RenderedTrainingView

#: Sparse points by which skylines are found.
_MAX_POINTS = 20_000


#: The map moves by pixels alone of which it makes at least this share: what stands before it has errors of its own.
MIN_SHOWN = 0.5


def view_skylines(capture: Capture, views: Sequence[View]) -> tuple[tuple[Skyline | None, ...], bool]:
    """The skylines of views of a capture, and whether they show sky, as `find_skylines`."""
    return find_skylines(lambda: scene_points(capture, _MAX_POINTS), [view.camera for view in views])


def with_sky(
    drawn: RenderedTrainingView, stage: TrainingProblem, view: int, decoder: Decoder, target: TrainingTarget,
    background: Float[Tensor, "3"],
) -> RenderedTrainingView:  # fmt: skip
    """The view with the environment map of the decoder, where it has one and the view shows sky. Going backward leaves
    in the `.grad` of the map how the loss changes with each of its cells: the mean over the pixels that count and show
    the cell, in the loss of one pixel. Cells that show for less than a pixel count as if it were one: Adam would move
    them as fast as the others, away from what no pixel holds."""
    envmap, skyline = decoder.envmap, None if stage.skylines is None else stage.skylines[view]
    if envmap is None or skyline is None:
        return drawn
    directions = ray_directions(target.camera, stage.device)
    # Rows without sky cost nothing more.
    shows = (directions[..., 2] > math.sin(float(skyline.min()))).any(dim=1).nonzero()[:, 0].tolist()
    if not shows:
        return drawn
    part = slice(shows[0], shows[-1] + 1)
    directions = directions[part]
    is_sky = above_skyline(directions, skyline)[..., None]
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
            alpha[part] -= (image[part] * difference).sum(-1)
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
