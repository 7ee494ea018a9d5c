"""Maps of a house, and whoever makes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.mapped_house import GROUND, TOP, capture_of, draw_maps, model_of
from vdgs.captures.capture import Capture
from vdgs.model.anchor_model import AnchorModel


@pytest.fixture
def make(tmp_path: Path):
    """Maps in a run of the test's own."""

    def run(capture: Capture, model: AnchorModel, **asked) -> Path:
        return draw_maps(run.path, capture, model, **asked)

    run.path = tmp_path / "run"
    return run


@pytest.fixture(scope="session")
def house() -> tuple[Capture, AnchorModel]:
    places = np.concatenate([GROUND, TOP])
    return capture_of(places), model_of(places)
