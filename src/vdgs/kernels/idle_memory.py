"""Returning unused memory to the system."""

from __future__ import annotations

import ctypes
from contextlib import suppress

from vdgs.kernels.cpu import extension


def trim_heap() -> None:
    """Return the rasterizer's idle memory and, with glibc, freed memory between blocks in use to the system. Takes some
    milliseconds: call it once in a hundred steps."""
    extension.get_extension().drop_idle_frames()
    with suppress(OSError, AttributeError, TypeError):  # other C libraries have no such function, or no such handle
        ctypes.CDLL(None).malloc_trim(0)
