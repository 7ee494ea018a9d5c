"""Memory that a process keeps but does not use, given back to the system."""

from __future__ import annotations

import ctypes
from contextlib import suppress

from vdgs.kernels.cpu import extension


def trim_heap() -> None:
    """Give back to the system what this process keeps but does not use.

    That is the rasteriser's idle memory and, with glibc, what was freed between pieces that are in use: after anchors
    were replaced by others, more than they take themselves. Costs some milliseconds: for once in a hundred steps.
    """
    extension.get_extension().drop_idle_frames()
    with suppress(OSError, AttributeError, TypeError):  # other C libraries have no such function, or no such handle
        ctypes.CDLL(None).malloc_trim(0)
