"""The exposure that pictures of a model are compared with photographs in.

A photograph is brighter or darker than the scene in neutral colours, and so is every photograph near it in the flight.
What those that trained tell of that may be used: no pixel of a photograph that is compared is.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.captures.order import places_in_flights
from vdgs.model.decoder import Decoder
from vdgs.model.exposure import interpolated


def exposures_of(decoder: Decoder, capture: Capture) -> Callable[[View], Float[Tensor, "3 4"]] | None:
    """The colour model (`model.exposure`) of any view of the capture that the decoder was trained on: that of a
    training view was fitted, that of a test view is interpolated along its flight. None where none was fitted."""
    if decoder.exposure is None:
        return None
    departures = decoder.exposure.detach().to("cpu", torch.float64)
    places = places_in_flights(view.name for view in capture.views)
    images = defaultdict[str, dict[int, int]](dict)
    for image, view in enumerate(capture.train_views):
        place = places[view.name]
        images[place.flight][place.number] = image

    def exposure(view: View) -> Float[Tensor, "3 4"]:
        place = places[view.name]
        return interpolated(departures, images[place.flight], place.number)

    return exposure


def as_photographed(
    picture: Float[np.ndarray, "*shape 3"], exposure: Float[Tensor, "3 4"]
) -> Float[np.ndarray, "*shape 3"]:
    """`model.exposure.exposed`, added up in one order: the bits of the result do not depend on the number of threads,
    so that views may be measured by several processes."""
    model = exposure.to(torch.float64).numpy()
    return (np.einsum("...c,dc->...d", picture, model[:, :3]) + model[:, 3]).astype(picture.dtype)
