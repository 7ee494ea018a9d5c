"""What a failure to get memory looks like. Nothing is imported that would itself need much."""

from __future__ import annotations

import errno
import os
import re
from contextlib import suppress

#: How the libraries word it: torch on the CPU (Linux, Windows), C++, OpenCV, the system.
OUT_OF_MEMORY_MESSAGES = (
    "can't allocate memory",
    "not enough memory",
    "bad_alloc",
    "Insufficient memory",
    "CUDA out of memory",
    "Cannot allocate memory",
)
#: How the system's loader words it of a library, whose path comes first, and why, where it says so.
_NOT_LOADED = re.compile(
    r"(?:(?P<library>/[^:]*): )?(?:failed to map segment from shared object|cannot map zero-fill pages"
    r"|Cannot allocate memory)(?P<why>: (?:Operation not permitted|Permission denied))?"
)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception means that memory could not be had, in main memory or on a card."""
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    return any(words in str(error) for words in OUT_OF_MEMORY_MESSAGES) or is_library_out_of_memory(error)


def is_library_out_of_memory(error: BaseException) -> bool:
    """Whether a library could not be loaded for want of memory, or of addresses that the process may use."""
    return _not_loaded(error) is not None and not barred_library(error)


def barred_library(error: BaseException) -> str:
    """The library that could not be loaded because no program may run where it lies (noexec), of which the loader says
    the same as of memory; empty for others."""
    said = _not_loaded(error)
    path = said and (said["library"] or getattr(error, "path", None))  # the loader names some without their folder
    if said and path:
        with suppress(OSError):
            return path if said["why"] or os.statvfs(path).f_flag & os.ST_NOEXEC else ""
    return "a library" if said and said["why"] else ""


def _not_loaded(error: BaseException) -> re.Match[str] | None:
    is_from_loading = isinstance(error, ImportError) or (isinstance(error, OSError) and error.errno is None)
    return _NOT_LOADED.search(str(error)) if is_from_loading else None
