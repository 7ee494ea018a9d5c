"""What the kernels return."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Raster(NamedTuple):
    """A drawn picture."""

    #: Colour over the background.
    image: Float[Tensor, "h w 3"]
    #: Opacity: 1 - T, where T is the share of the background that shows through.
    alpha: Float[Tensor, "h w"]
    #: Expected depth, the sum of w_i depth_i: not divided by alpha, 0 where nothing is drawn.
    #: None if it was not asked for.
    depth: Float[Tensor, "h w"] | None
