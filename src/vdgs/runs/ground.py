"""Where the photographs of a capture show ground, by the places where its anchors start."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture
from vdgs.model.start import initial_anchors
from vdgs.model.visibility import visibility_of
from vdgs.settings.method import AnchorConfig


def ground_of(
    capture: Capture, config: AnchorConfig, dense: tuple[np.ndarray, np.ndarray] | None = None
) -> Float[Tensor, "g 3"]:
    """The places where anchors start and that any training camera holds (`model.ground`); `dense` as in
    `initial_anchors`."""
    cameras = [view.camera for view in capture.train_views]
    anchors, _ = initial_anchors(capture.points, capture.point_colours, cameras, config, dense)
    return anchors.positions[visibility_of(anchors.positions, cameras) >= 1]
