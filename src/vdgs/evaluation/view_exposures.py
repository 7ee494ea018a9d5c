"""The exposure in which images of a model are compared with photographs.

A photograph is brighter or darker than the scene in neutral colors, and so are its neighbors in the flight. Where the
camera chose its exposure, what it saw decides too. Only training photographs are used: no pixel of a compared one.

Automatic exposure: over bright fields a camera lets in less light than over a wood. The trained scene is drawn in
neutral colors and metered as cameras do, most at the middle. The response is learnt from training photographs, each
against its neighbors: with x the logarithm of how much brighter the scene is than between the neighbors, and y that
of how much brighter the photograph is exposed, y = slope x. A fixed exposure has slope 0; -1 makes all images alike.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_order import flight_positions
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.exposure import apply_exposure, exposure_matrix, find_flight_neighbors, interpolate_exposure
from vdgs.model.renderer import render

#: Training photographs that the law of metering is learnt from at most, evenly chosen: each is drawn small, and so are
#: its two neighbors.
MAX_SAMPLE_VIEWS = 64
#: Pictures are metered at this longest side: it is a mean that is wanted.
METERING_SIZE_PX = 96
#: Width of the bell that weighs pixels about the middle, in sides of the picture (choice).
CENTER_SIGMA = 0.2
#: Luminance of red, green and blue (ITU-R BT.601), and what is added to it: nothing is quite black.
LUMINANCE_WEIGHTS, MIN_LUMINANCE = np.array([0.299, 0.587, 0.114]), 1e-3
#: Fewer photographs than this teach nothing.
MIN_SAMPLES = 8
#: The law is used where it foretells photographs that it was not learnt from with at most so much of the error that
#: their neighbors alone leave.
MAX_ERROR_RATIO = 0.95


def make_exposures(
    model: AnchorModel, capture: Capture, draw: Callable[[Camera], Raster] | None = None
) -> ViewExposures | None:
    """The color model (`model.exposure`) of any view of the capture that a model was trained on. None where training
    fitted none. They are of pictures without `AnchorModel.local_exposure`. `draw` makes the small pictures that are
    metered, where not the whole model shall."""
    return None if model.decoder.exposure is None else ViewExposures(model, capture, draw)


class ViewExposures:
    """The color models of views: that of a training view was fitted, that of a test view is interpolated along its
    flight, and corrected for what the camera metered there."""

    def __init__(self, model: AnchorModel, capture: Capture, draw: Callable[[Camera], Raster] | None = None):
        self._render = draw or (lambda camera: render(model.without_local_exposure(), camera))
        exposure = model.decoder.exposure
        assert exposure is not None, "training fitted no exposures"
        self._departures = exposure.detach().to("cpu", torch.float64)
        self._positions = flight_positions(view.name for view in capture.views)
        self._trained = list(capture.train_views)
        self._flights = defaultdict[str, dict[int, int]](dict)
        for image, view in enumerate(self._trained):
            position = self._positions[view.name]
            self._flights[position.flight][position.number] = image
        self._measured = cache(self._measure)

    def __call__(self, view: View) -> Float[Tensor, "3 4"]:
        """The color model of a view, [A | b] in float64."""
        position = self._positions[view.name]
        images = self._flights[position.flight]
        exposure = interpolate_exposure(self._departures, images, position.number)
        near = find_flight_neighbors(images, position.number)
        if near is None or position.number in images or not self.auto_exposure.slope:
            return exposure
        expected = (1 - near.share) * self._measured(near.first)[0] + near.share * self._measured(near.last)[0]
        return exposure * self.auto_exposure.gain(log_luminance(self._render_small(view)) - expected)

    @cached_property
    def auto_exposure(self) -> AutoExposure:
        """How the cameras of this capture meter, from training photographs between two others."""
        departures: list[np.ndarray] = []
        last = len(self._trained) - 1
        chosen = np.unique(np.linspace(0, last, min(MAX_SAMPLE_VIEWS, last + 1)).astype(int))
        for image in chosen.tolist():
            position = self._positions[self._trained[image].name]
            near = find_flight_neighbors(self._flights[position.flight], position.number, include_self=False)
            if near is None or near.first == near.last:
                continue
            shares = {near.first: 1 - near.share, near.last: near.share}
            between = sum(s * np.array(self._measured(other)) for other, s in shares.items())
            departures.append(np.array(self._measured(image)) - between)
        brighter, gains = np.array(departures).reshape(-1, 2).T
        return fit_auto_exposure(brighter, gains)

    def _measure(self, image: int) -> tuple[float, float]:
        """What a camera meters in the view of a training photograph, and by how much the photograph is brighter than
        neutral, as logarithms."""
        neutral = self._render_small(self._trained[image])
        exposure = exposure_matrix(self._departures, image)
        exposed = apply_exposure(torch.from_numpy(neutral).double(), exposure).clamp(0, 1).numpy()
        metered = log_luminance(neutral)
        return metered, log_luminance(exposed) - metered

    def _render_small(self, view: View) -> Float[np.ndarray, "h w 3"]:
        """A view in neutral colors, small."""
        shrunk = min(1.0, METERING_SIZE_PX / max(view.camera.width, view.camera.height))
        width, height = (max(1, round(shrunk * side)) for side in (view.camera.width, view.camera.height))
        image: np.ndarray = self._render(view.camera.resized(width, height)).image.clamp(0, 1).cpu().numpy()
        return image


def apply_exposure_numpy(
    image: Float[np.ndarray, "*shape 3"], exposure: Float[Tensor, "3 4"]
) -> Float[np.ndarray, "*shape 3"]:
    """`model.exposure.apply_exposure` with a fixed order of sums: its bits do not depend on the number of threads."""
    model = exposure.to(torch.float64).numpy()
    return (np.einsum("...c,dc->...d", image, model[:, :3]) + model[:, 3]).astype(image.dtype)


@dataclass(frozen=True)
class AutoExposure:
    """How cameras of a capture answer to brightness; slope 0: they do not."""

    #: Between -1 and 0.
    slope: float
    #: Brightness beyond what was learnt from counts as this much, either way.
    max_brightness: float
    #: By how much, as logarithms and in the root of the mean square, photographs are brighter than foretold by their
    #: neighbors alone, and by what is metered as well, each by a law that was learnt without it. NaN without any law.
    residual_error: tuple[float, float] = (math.nan, math.nan)

    def gain(self, brighter: float) -> float:
        """The factor on the exposure of a photograph whose view is brighter than between its neighbors, by the
        logarithm."""
        return float(np.exp(self.slope * np.clip(brighter, -self.max_brightness, self.max_brightness)))


def log_luminance(image: Float[np.ndarray, "h w 3"]) -> float:
    """The logarithm of a picture's luminance, most of it from the middle."""
    rows, columns = (np.exp(-0.5 * (((np.arange(n) + 0.5) / n - 0.5) / CENTER_SIGMA) ** 2) for n in image.shape[:2])
    weights = rows[:, None] * columns
    # Products and sums of numpy alone: the bits do not depend on the number of threads.
    light = (image.astype(np.float64) * LUMINANCE_WEIGHTS).sum(-1)
    return float(np.log((light * weights).sum() / weights.sum() + MIN_LUMINANCE))


def fit_auto_exposure(brighter: Float[np.ndarray, " n"], gains: Float[np.ndarray, " n"]) -> AutoExposure:
    """The law that n photographs tell, each by how much brighter its view is and how much brighter it was exposed than
    its neighbors; slope 0 where that foretells hardly better those that are left out, one after the other."""
    products, squares = brighter * gains, brighter**2
    if len(gains) < MIN_SAMPLES or squares.sum() <= squares.max() * (1 + 1e-9):
        return AutoExposure(0.0, 0.0)
    without = np.clip((products.sum() - products) / (squares.sum() - squares), -1.0, 0.0)
    alone, metered_too = (float(np.sqrt(np.square(error).mean())) for error in (gains, gains - without * brighter))
    if metered_too > MAX_ERROR_RATIO * alone:
        return AutoExposure(0.0, 0.0, (alone, metered_too))
    slope = np.clip(products.sum() / squares.sum(), -1.0, 0.0)
    return AutoExposure(float(slope), float(np.abs(brighter).max()), (alone, metered_too))
