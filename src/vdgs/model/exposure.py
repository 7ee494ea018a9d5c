"""The exposure of each photograph: a small affine model of its colours, fitted while the scene is trained.

Photographs of one flight differ in brightness and white balance. Without a model of that, the scene takes the mean
where many look, and the exposure of the one or two photographs that show it where few do. A photograph's model departs
from the mean of all: the mean itself is neutral by construction, and it is neutral colours that a scene is drawn in.

Exposure drifts along a flight, so that of a photograph without a model follows from those taken just before and after
it (`interpolate_exposure`). It is what test photographs are compared in.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

#: Farther than so many places along a flight, exposures say nothing of each other (choice).
MAX_FLIGHT_GAP = 8


def zero_exposures(images: int) -> Float[Tensor, "images 3 4"]:
    """Departures of so many photographs, none of which departs yet."""
    return torch.zeros(images, 3, 4)


def exposure_matrix(departures: Float[Tensor, "images 3 4"], image: int) -> Float[Tensor, "3 4"]:
    """The colour model [A | b] of a photograph: c -> A c + b. Over all photographs their mean is [1 | 0]."""
    return _neutral(departures) + departures[image] - departures.mean(0)


class FlightNeighbors(NamedTuple):
    """The nearest photographs before and after a place of a flight, as rows (twice the same one at an end of the
    flight), and how far from the first to the last the place lies, 0 to 1."""

    first: int
    last: int
    share: float

    def interpolate(self, values: Float[Tensor, "images *shape"]) -> Float[Tensor, "*shape"]:
        """The value at the place, linear between the two."""
        return torch.lerp(values[self.first], values[self.last], self.share)


def find_flight_neighbors(images: Mapping[int, int], place: int, include_self: bool = True) -> FlightNeighbors | None:
    """Those of a place among the photographs of a flight: `images` are rows by their places in it. A photograph that
    stands there is its own unless not `itself`. None if even the nearest is more than `MAX_FLIGHT_GAP` places away."""
    others = images.keys() if include_self else images.keys() - {place}
    before = max((other for other in others if other <= place), default=None)
    after = min((other for other in others if other >= place), default=None)
    near = [other for other in (before, after) if other is not None]
    if not near or min(abs(other - place) for other in near) > MAX_FLIGHT_GAP:
        return None
    first, last = near[0], near[-1]
    return FlightNeighbors(images[first], images[last], (place - first) / (last - first) if last > first else 0.0)


def interpolate_exposure(
    departures: Float[Tensor, "images 3 4"], images: Mapping[int, int], place: int
) -> Float[Tensor, "3 4"]:
    """The colour model [A | b] of a photograph at a place of a flight, from those that have one: `images` are the rows
    of `departures` that belong to the flight, by their places in it.

    Linear between the nearest before and the nearest after it; at an end of the flight, that of the nearest; the own
    one of a photograph that has one; neutral if even the nearest is more than `MAX_FLIGHT_GAP` places away.
    """
    near = find_flight_neighbors(images, place)
    if near is None:
        return _neutral(departures)
    return torch.lerp(exposure_matrix(departures, near.first), exposure_matrix(departures, near.last), near.share)


def apply_exposure(image: Float[Tensor, "h w 3"], exposure: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """A picture in neutral colours as the photograph with that model has them."""
    return image @ exposure[:, :3].T + exposure[:, 3]


def _neutral(departures: Float[Tensor, "images 3 4"]) -> Float[Tensor, "3 4"]:
    return torch.eye(3, 4, dtype=departures.dtype, device=departures.device)
