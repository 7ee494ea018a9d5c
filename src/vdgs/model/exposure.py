"""The exposure of each photograph: an affine model of its colors, trained with the scene.

Photographs of one flight differ in brightness and white balance. A photograph's model is its departure from neutral
colors, in which the scene is drawn: those nearest to all photographs (`training.exposure_centering`). Exposure drifts
along a flight: that of a test photograph is interpolated from those taken just before and after it
(`interpolate_exposure`).
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
    """Departures of `images` photographs, all zero."""
    return torch.zeros(images, 3, 4, dtype=torch.float32, device="cpu")


def exposure_matrix(departures: Float[Tensor, "images 3 4"], image: int) -> Float[Tensor, "3 4"]:
    """The color model [A | b] of a photograph: c -> A c + b; [1 | 0] where it does not depart from neutral colors."""
    return _neutral(departures) + departures[image]


class FlightNeighbors(NamedTuple):
    """Rows of the nearest photographs before and after a position in a flight (the same one twice at an end), and the
    position between them, 0 to 1."""

    first: int
    last: int
    share: float

    def interpolate(self, values: Float[Tensor, "images *shape"]) -> Float[Tensor, "*shape"]:
        """The value at the place, linear between the two."""
        return torch.lerp(values[self.first], values[self.last], self.share)


def find_flight_neighbors(images: Mapping[int, int], place: int, include_self: bool = True) -> FlightNeighbors | None:
    """The neighbors of a position in a flight: `images` maps positions to rows. A photograph at `place` counts only
    with `include_self`. None if the nearest is more than `MAX_FLIGHT_GAP` positions away."""
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
    """The color model [A | b] at a position in a flight, linear between its neighbors; `images` maps positions to
    rows of `departures`. That of the nearest at an end of the flight; neutral if none is within `MAX_FLIGHT_GAP`
    positions."""
    near = find_flight_neighbors(images, place)
    if near is None:
        return _neutral(departures)
    return torch.lerp(exposure_matrix(departures, near.first), exposure_matrix(departures, near.last), near.share)


def apply_exposure(image: Float[Tensor, "h w 3"], exposure: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """A picture in neutral colors as the photograph with that model has them."""
    return image @ exposure[:, :3].T + exposure[:, 3]


def apply_exposure_backward(
    image: Float[Tensor, "h w 3"], exposure: Float[Tensor, "3 4"], gradient: Float[Tensor, "h w 3"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "3 4"]]:
    """Gradients of a loss by what `apply_exposure` was given, from that by what it made."""
    matrix = gradient.flatten(0, 1).T @ image.flatten(0, 1)
    return gradient @ exposure[:, :3], torch.cat([matrix, gradient.sum((0, 1))[:, None]], dim=1)


def _neutral(departures: Float[Tensor, "images 3 4"]) -> Float[Tensor, "3 4"]:
    return torch.eye(3, 4, dtype=departures.dtype, device=departures.device)
