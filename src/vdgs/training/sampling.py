"""How often each photograph is used."""

from __future__ import annotations

import math
from collections.abc import Sequence

from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.model.anchors import Anchors
from vdgs.visibility.visibility_counts import votes_of


def shares_for(config: TrainConfig, anchors: Anchors, cameras: Sequence[Camera]) -> tuple[float, ...] | None:
    """How often each training view is used, by the settings, for the anchors that training starts with.

    Roots, because a view with few votes also costs little (`training.crops`): a mean varies least for what it costs
    if strata are drawn in proportion to their weight over the root of their cost (Cochran, 1977, section 5.5).
    """
    if config.sampling == "even":
        return None
    votes = votes_of(anchors.positions, cameras)
    return votes if config.sampling == "shares" else tuple(math.sqrt(share) for share in votes)
