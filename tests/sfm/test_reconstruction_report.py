"""What the report of a reconstruction says of a model, in numbers."""

from __future__ import annotations

import numpy as np
import pytest

from support.flown_models import flown_model
from vdgs.geometry.similarity import Similarity
from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.reconstruction_report import _heights, _rms


def test_residuals_are_of_the_positions_that_are_trusted():
    residuals = np.array([[3.0, 0, 1], [4.0, 0, -1], [500.0, 500, 500]])
    placed = Georegistration(
        similarity=Similarity(1.0, np.eye(3), np.zeros(3)), method="GPS", position_rows=np.arange(3),
        targets=np.zeros((3, 3)), residuals=residuals, inliers=np.array([True, True, False]),
    )  # fmt: skip
    assert _rms(placed) == pytest.approx((12.5**0.5, 0, 1))


def test_the_height_is_over_the_ground_wherever_that_lies():
    places = np.array([[x, y, 60.0] for x in (-20.0, 0, 20) for y in (-20.0, 0, 20)])
    model, _ = flown_model(places, np.random.default_rng(0))
    images = list(model.images.values())
    over = _heights(model, images)
    assert np.median(over) == pytest.approx(60, abs=5)
    for point in model.points3D.values():
        point.xyz = point.xyz - [0, 0, 100.0]
    assert _heights(model, images) == pytest.approx(over + 100)
