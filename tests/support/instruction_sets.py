"""Which native kernels a test runs, and on how many threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest

from vdgs.kernels.cpu import extension

#: Runs a test once for every instruction set that this processor supports.
every_instruction_set = pytest.mark.parametrize("instructions", extension.supported_isas())


@contextmanager
def using(instructions: str) -> Iterator[None]:
    """Run the kernels built for one instruction set."""
    with patch.object(extension, "get_extension", lambda: extension.load_extension(instructions)):
        yield


@contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Let the kernels use `count` threads."""
    before = extension.get_num_threads()
    extension.set_num_threads(count)
    try:
        yield
    finally:
        extension.set_num_threads(before)
