"""A finished run of two blocks, and a copy of it that a test may change."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.clusters import copy_run


@pytest.fixture(scope="module")
def capture(two_blocks) -> Path:
    return two_blocks.capture


@pytest.fixture(scope="module")
def unbroken(two_blocks) -> Path:
    return two_blocks.run


@pytest.fixture
def copied(unbroken, tmp_path) -> Path:
    return copy_run(unbroken, tmp_path / "run")
