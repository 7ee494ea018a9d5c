"""Reconstructions draw small figures: what they show, others test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from support.commands import small_figures


@pytest.fixture(autouse=True)
def draw_small_figures() -> Iterator[None]:
    with small_figures():
        yield
