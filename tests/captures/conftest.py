"""What tests of captures share."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.captures import TinyScene, tiny_scene, write_colmap


@pytest.fixture
def scene() -> TinyScene:
    return tiny_scene()


@pytest.fixture
def folder(tmp_path: Path, scene: TinyScene) -> Path:
    """A capture of it."""
    write_colmap(tmp_path, scene)
    return tmp_path
