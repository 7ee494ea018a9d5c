"""Where the photographs of a capture show ground, by the places where its anchors start."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture
from vdgs.model.ground import known_ground
from vdgs.model.start import initial_anchors
from vdgs.settings.method import AnchorConfig


def ground_of(capture: Capture, config: AnchorConfig) -> Float[Tensor, "g 3"]:
    """The places where anchors start and that enough training cameras see (`model.ground`)."""
    cameras = [view.camera for view in capture.train_views]
    anchors, _ = initial_anchors(capture.points, capture.point_colours, cameras, config)
    return known_ground(anchors.positions, cameras)
