"""The exposure of each photograph: a small affine model of its colours, fitted while the scene is trained.

Photographs of one flight differ in brightness and white balance. Without a model of that, the scene takes the mean
where many look, and the exposure of the one or two photographs that show it where few do. A photograph's model departs
from the mean of all: the mean itself is neutral by construction, and it is neutral colours that a scene is drawn and
measured in.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def neutral_exposures(images: int) -> Float[Tensor, "images 3 4"]:
    """Departures of so many photographs, none of which departs yet."""
    return torch.zeros(images, 3, 4)


def exposure_of(departures: Float[Tensor, "images 3 4"], image: int) -> Float[Tensor, "3 4"]:
    """The colour model [A | b] of a photograph: c -> A c + b. Over all photographs their mean is [1 | 0]."""
    neutral = torch.eye(3, 4, dtype=departures.dtype, device=departures.device)
    return neutral + departures[image] - departures.mean(0)


def exposed(image: Float[Tensor, "h w 3"], exposure: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """A picture in neutral colours as the photograph with that model has them."""
    return image @ exposure[:, :3].T + exposure[:, 3]
