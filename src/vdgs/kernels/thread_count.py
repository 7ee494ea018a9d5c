"""How many threads to use, without loading anything that uses them."""

from __future__ import annotations

import os

from vdgs.errors import VdgsError


def cpu_count() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_num_threads() -> int:
    """`VDGS_THREADS`, or the number of cores that this process may use. VdgsError for another value of the variable."""
    text = os.environ.get("VDGS_THREADS")
    if not text:
        return cpu_count()
    if not text.isdecimal() or int(text) < 1:
        raise VdgsError(f"VDGS_THREADS must be a whole number from 1, not {text!r}.")
    return int(text)
