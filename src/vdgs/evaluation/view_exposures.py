"""The exposure that pictures of a model are compared with photographs in.

A photograph is brighter or darker than the scene in neutral colours, and so is every photograph near it in the flight.
Where the camera chose its exposure by itself, what it saw decides too (`auto_exposure`). What the photographs that trained
tell of that may be used: no pixel of a photograph that is compared is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import cache, cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_order import flight_positions
from vdgs.evaluation.auto_exposure import METERING_SIZE_PX, AutoExposure, fit_auto_exposure, log_luminance
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.exposure import apply_exposure, exposure_matrix, find_flight_neighbors, interpolate_exposure
from vdgs.model.renderer import render

#: Training photographs that the law of metering is learnt from at most, evenly chosen: each is drawn small, and so are
#: its two neighbours.
MAX_SAMPLE_VIEWS = 64


def make_exposures(
    model: AnchorModel, capture: Capture, draw: Callable[[Camera], Raster] | None = None
) -> ViewExposures | None:
    """The colour model (`model.exposure`) of any view of the capture that a model was trained on. None where training
    fitted none. `draw` makes the small pictures that are metered, where not the whole model shall."""
    return None if model.decoder.exposure is None else ViewExposures(model, capture, draw)


class ViewExposures:
    """The colour models of views: that of a training view was fitted, that of a test view is interpolated along its
    flight, and corrected for what the camera metered there."""

    def __init__(self, model: AnchorModel, capture: Capture, draw: Callable[[Camera], Raster] | None = None):
        self._render = draw or (lambda camera: render(model, camera))
        departures = model.decoder.exposure
        assert departures is not None, "training fitted no exposures"
        self._departures = departures.detach().to("cpu", torch.float64)
        self._places = flight_positions(view.name for view in capture.views)
        self._trained = list(capture.train_views)
        self._flights = defaultdict[str, dict[int, int]](dict)
        for image, view in enumerate(self._trained):
            place = self._places[view.name]
            self._flights[place.flight][place.number] = image
        self._metered = cache(lambda image: log_luminance(self._drawn(self._trained[image])))

    def __call__(self, view: View) -> Float[Tensor, "3 4"]:
        """The colour model of a view, [A | b] in float64."""
        place = self._places[view.name]
        images = self._flights[place.flight]
        found = interpolate_exposure(self._departures, images, place.number)
        near = find_flight_neighbors(images, place.number)
        if near is None or place.number in images or not self.auto_exposure.slope:
            return found
        expected = (1 - near.share) * self._metered(near.first) + near.share * self._metered(near.last)
        return found * self.auto_exposure.gain(log_luminance(self._drawn(view)) - expected)

    @cached_property
    def auto_exposure(self) -> AutoExposure:
        """How the cameras of this capture meter, from training photographs between two others."""
        brighter, gains = [], []
        chosen = np.unique(
            np.linspace(0, len(self._trained) - 1, min(MAX_SAMPLE_VIEWS, len(self._trained))).astype(int)
        )
        for image in chosen.tolist():
            place = self._places[self._trained[image].name]
            near = find_flight_neighbors(self._flights[place.flight], place.number, include_self=False)
            if near is None or near.first == near.last:
                continue
            shares = {near.first: 1 - near.share, near.last: near.share}
            brighter.append(self._metered(image) - sum(s * self._metered(other) for other, s in shares.items()))
            gains.append(self._gain(image) - sum(s * self._gain(other) for other, s in shares.items()))
        return fit_auto_exposure(np.array(brighter), np.array(gains))

    def _gain(self, image: int) -> float:
        """By how much a training photograph is brighter than neutral, as a logarithm."""
        neutral = torch.from_numpy(self._drawn(self._trained[image])).double()
        picture = apply_exposure(neutral, exposure_matrix(self._departures, image)).clamp(0, 1).numpy()
        return log_luminance(picture) - self._metered(image)

    def _drawn(self, view: View) -> Float[np.ndarray, "h w 3"]:
        """A view in neutral colours, small."""
        shrunk = min(1.0, METERING_SIZE_PX / max(view.camera.width, view.camera.height))
        width, height = (max(1, round(shrunk * side)) for side in (view.camera.width, view.camera.height))
        picture: np.ndarray = self._render(view.camera.resized(width, height)).image.clamp(0, 1).cpu().numpy()
        return picture


def apply_exposure_numpy(
    image: Float[np.ndarray, "*shape 3"], exposure: Float[Tensor, "3 4"]
) -> Float[np.ndarray, "*shape 3"]:
    """`model.exposure.apply_exposure`, added up in one order: the bits of the result do not depend on the number of threads,
    so that views may be measured by several processes."""
    model = exposure.to(torch.float64).numpy()
    return (np.einsum("...c,dc->...d", image, model[:, :3]) + model[:, 3]).astype(image.dtype)
