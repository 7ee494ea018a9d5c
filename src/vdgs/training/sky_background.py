"""What a training step shows behind the anchors where a photograph looks above the scene: the environment map.

Below the skyline a random color stays, so that ground cannot borrow its color from the map. The map is composed with
the picture outside the rasterizer: a pixel is C + T (sky - b) + T b with the plain background b and transmittance T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.captures.scene_points import scene_points
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import RasterGradients
from vdgs.model.decoder import Decoder
from vdgs.model.envmap import ray_directions, sample_envmap
from vdgs.model.initialization.sky import Skyline, above_skyline, find_skylines
from vdgs.training.training_state import TrainingProblem
from vdgs.training.training_step import RenderedTrainingView

#: Sparse points by which skylines are found.
_MAX_POINTS = 20_000


def view_skylines(capture: Capture, views: Sequence[View]) -> tuple[tuple[Skyline | None, ...], bool]:
    """The skylines of views of a capture, and whether they show sky, as `find_skylines`."""
    return find_skylines(lambda: scene_points(capture, _MAX_POINTS), [view.camera for view in views])


def with_sky(
    drawn: RenderedTrainingView, stage: TrainingProblem, view: int, decoder: Decoder, camera: Camera,
    background: Float[Tensor, "3"],
) -> RenderedTrainingView:  # fmt: skip
    """The view with the environment map of the decoder, where it has one and the view shows sky. Going backward leaves
    the gradient of the map in its `.grad`."""
    envmap, skyline = decoder.envmap, None if stage.skylines is None else stage.skylines[view]
    if envmap is None or skyline is None:
        return drawn
    directions = ray_directions(camera, stage.device)
    is_sky = above_skyline(directions, skyline)[..., None]
    sky = sample_envmap(envmap, directions)
    through = (1 - drawn.raster.alpha)[..., None] * is_sky
    difference = (sky.detach() - background) * is_sky

    def pullback(
        image: Tensor | None, alpha: Tensor | None = None, depth: Tensor | None = None,
        out: tuple[Tensor, Tensor] | None = None, count: int | None = None,
    ) -> RasterGradients:  # fmt: skip
        if image is not None:
            by_alpha = -(image * difference).sum(-1)
            alpha = by_alpha if alpha is None else alpha + by_alpha
            if envmap.requires_grad:
                with torch.enable_grad():
                    (envmap.grad,) = torch.autograd.grad((sky * (image * through)).sum(), [envmap])
        return drawn.pullback(image, alpha, depth, out=out, count=count)

    return replace(drawn, image=drawn.image + through * difference, pullback=pullback)
