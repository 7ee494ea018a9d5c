"""A scene that all tests of what a viewer draws and says look at."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support.hand_made_models import quadrants, two_floors
from support.viewer_scene import photographed
from vdgs.partition.blocks import save_blocks
from vdgs.viewer.viewer_scene import ViewerScene


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ViewerScene]:
    """Nine photographs that a model of two floors has itself drawn; four blocks."""
    folder = tmp_path_factory.mktemp("viewer")
    opened = photographed(folder, two_floors(), lambda number, image: image)
    save_blocks(folder / "run/partition/blocks.geojson", quadrants(), [{}] * 4)
    opened.__dict__["blocks"] = quadrants()
    yield opened
    opened.close()
