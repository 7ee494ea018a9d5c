"""What training is told of the places of a capture that few cameras see, where settings ask for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from vdgs.captures.capture import Capture, View
from vdgs.model.seldom import Seldom
from vdgs.settings.method import SeldomConfig
from vdgs.training.depths import KnownDepths


def seldom_terms(
    capture: Capture, starts: Float[Tensor, "g 3"], views: Sequence[View], config: SeldomConfig
) -> dict[str, Any]:
    """The fields of `training.Stage` about places that few cameras see, for training with the given views; none where
    the settings ask for nothing. `starts` are the places where the capture's anchors start."""
    if not config.asked:
        return {}
    seldom = Seldom([view.camera for view in capture.train_views], starts, config.quantile)
    terms: dict[str, Any] = {"seldom": seldom}
    if config.smooth_weight:
        terms["seldom_cells"] = [seldom.cells(view.camera) for view in views]
    if config.depth_weight:
        terms["known_depths"] = [
            None if view.sightings is None else KnownDepths.of(view.sightings, view.camera, seldom) for view in views
        ]
    return terms
