"""Which colors are neutral: those that come nearest to all photographs where one exposure is to do for all of them.

A scene in other colors, with exposures that undo the change, shows the same photographs: they leave open which colors
the scene has, and training drifts. Of photograph i let x be (color, 1) of a pixel in neutral colors, D_i its departure
([1 | 0] + D_i is its exposure) and S_i the mean of x xᵀ over its pixels. Of all maps of colors, [1 | 0] + M with

    M = (Σ D_i S_i) (Σ S_i)⁻¹

is nearest to all exposures, by the squares of the differences in their pixels. After each pass over the photographs, as
training draws them, M is taken from all departures, and the colors of the scene follow. (The mean of the departures in
place of M does not see that cameras expose bright places less, nor how alike red, green and blue are.)

A trained scene is drawn in what photographs of each place depart by from that (`with_local_exposure`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import pad

from vdgs.geometry.camera import Camera
from vdgs.kernels.transfer import is_host
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.local_exposure import fit_local_exposure
from vdgs.model.renderer import render

#: Of each photograph rows and columns are left out until at most so many pixels are left; those are counted where the
#: scene is at least so opaque.
MAX_PIXELS, MIN_ALPHA = 30_000, 0.5
#: Pictures of a trained scene that tell the colors of a photograph have this longest side (choice).
SMALL_PX = 96
#: Added to the diagonal of Σ S_i, as a share of its trace: photographs in one color leave M open. And so much alone:
#: where nothing was counted, M is 0.
RIDGE, TINY = 1e-7, 1e-30

#: Σ D_i S_i above Σ S_i, float64.
ExposureMoments = Float[Tensor, "7 4"]


def zero_moments(device: torch.device) -> ExposureMoments:
    """The sums before the first photograph."""
    return torch.zeros(7, 4, dtype=torch.float64, device=device)


@torch.no_grad()
def count_exposure(
    moments: ExposureMoments,
    departure: Float[Tensor, "3 4"],
    image: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    mask: UInt8[Tensor, "h w"] | None,
) -> None:
    """Add a photograph with the picture of the scene in neutral colors, in place; pixels that its mask leaves out do
    not count."""
    part = slice(None, None, math.ceil(math.sqrt(alpha.numel() / MAX_PIXELS)))
    counted = alpha[part, part] >= MIN_ALPHA
    if mask is not None:
        counted = counted & (mask[part, part] > 0)
    of_colors = _mean_of_products(image.detach()[part, part], counted)
    moments[:3] += departure.double() @ of_colors
    moments[3:] += of_colors


def _mean_of_products(image: Float[Tensor, "h w 3"], counted: Bool[Tensor, "h w"]) -> Float[Tensor, "4 4"]:
    """The mean of x xᵀ over the pixels that count; 0 where none does."""
    colors = pad(image.double(), (0, 1), value=1.0).mul_(counted[..., None])
    products = _sum_of_products(colors.flatten(0, 1))
    return products / products[3, 3].clamp(min=1)  # of ones: how many pixels count


def _sum_of_products(colors: Float[Tensor, "p 4"]) -> Float[Tensor, "4 4"]:
    """Σ x xᵀ. On a CPU with the same bits for any number of threads, which a product of torch does not promise."""
    if not is_host(colors):
        return colors.T @ colors
    return torch.from_numpy(np.einsum("pi,pj->ij", colors.numpy(), colors.numpy()))


@torch.no_grad()
def center_exposures(departures: Float[Tensor, "images 3 4"], moments: ExposureMoments) -> None:
    """Take M from all departures, in place, and set the sums back to 0. M is 0 where nothing was counted."""
    ridge = RIDGE * moments[3:].trace() + TINY
    of_colors = moments[3:] + ridge * torch.eye(4, dtype=moments.dtype, device=moments.device)
    # `solve` would wait for a GPU to see whether it could.
    departures -= torch.linalg.solve_ex(of_colors, moments[:3].T)[0].T.to(departures)
    moments.zero_()


def with_local_exposure(
    model: AnchorModel, cameras: Sequence[Camera], on_progress: Callable[[int, int], None] = lambda done, total: None
) -> AnchorModel:
    """A trained model, in the exposure that photographs of a place have in the mean (`AnchorModel.local_exposure`), if
    exposures were fitted; itself where it has one. `cameras` are those of the training photographs, each of which is
    drawn, small; `on_progress` is told of how many of them that is done."""
    exposure, positions = model.decoder.exposure, model.anchors.positions
    if exposure is None or model.local_exposure is not None:
        return model
    moments = []
    for camera in cameras:
        moments.append(_color_moments(model, camera))
        on_progress(len(moments), len(cameras))
    found = fit_local_exposure(exposure, torch.stack(moments), cameras, positions)
    return replace(model, local_exposure=found.to(positions.device))


def _color_moments(model: AnchorModel, camera: Camera) -> Float[Tensor, "4 4"]:
    """S of a photograph, by a small picture of the scene."""
    shrunk = min(1.0, SMALL_PX / max(camera.width, camera.height))
    width, height = (max(1, round(shrunk * side)) for side in (camera.width, camera.height))
    drawn = render(model, camera.resized(width, height))
    return _mean_of_products(drawn.image, drawn.alpha >= MIN_ALPHA)
