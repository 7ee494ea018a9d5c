"""One browser for all pages."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def one_browser() -> Iterator[None]:
    yield
    if "support.viewer" in sys.modules:  # it is not imported where all of these tests are skipped
        sys.modules["support.viewer"].close_browser()
