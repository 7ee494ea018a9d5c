"""How much memory this process takes, and took at most."""

from __future__ import annotations

import ctypes
import gc
import resource
import sys
from contextlib import suppress
from pathlib import Path

from vdgs.kernels.native import module


def peak_memory_bytes() -> int:
    """Largest resident size of this process since it began, or since `forget_peak` where the system can forget."""
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak if sys.platform == "darwin" else peak * 1024)


def forget_peak() -> None:
    """Let the peak begin again at today's size, so that each stage of a run is measured apart (Linux)."""
    gc.collect()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def return_unused() -> None:
    """Give back to the system what this process keeps but does not use.

    That is the rasteriser's idle memory and, with glibc, what was freed between pieces that are in use: after anchors
    were replaced by others, more than they take themselves. Costs some milliseconds: for once in a hundred steps.
    """
    module.native().drop_idle_frames()
    with suppress(OSError, AttributeError, TypeError):  # other C libraries have no such function, or no such handle
        ctypes.CDLL(None).malloc_trim(0)
