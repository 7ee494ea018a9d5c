"""What tests of captures share."""

from __future__ import annotations

import pytest

from support.captures import TinyScene, tiny_scene


@pytest.fixture
def scene() -> TinyScene:
    return tiny_scene()
