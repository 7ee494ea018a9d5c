"""What a failure to get memory looks like. Nothing is imported that would itself need much."""

from __future__ import annotations

import errno
import re

#: How the libraries word it: torch on the CPU (Linux, Windows), C++, OpenCV, the system.
OUT_OF_MEMORY_MESSAGES = (
    "can't allocate memory",
    "not enough memory",
    "bad_alloc",
    "Insufficient memory",
    "CUDA out of memory",
    "Cannot allocate memory",
)
#: How the system's loader words it of a library. A file system whose programs may not run (noexec) has similar words.
_NOT_LOADED = re.compile(
    r"failed to map segment from shared object(?!: (?:Operation not permitted|Permission denied))"
    r"|cannot map zero-fill pages|Cannot allocate memory"
)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception means that memory could not be had, in main memory or on a card."""
    if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
        return True
    return any(words in str(error) for words in OUT_OF_MEMORY_MESSAGES) or is_library_out_of_memory(error)


def is_library_out_of_memory(error: BaseException) -> bool:
    """Whether a library could not be loaded for want of memory, or of addresses that the process may use."""
    is_from_loading = isinstance(error, ImportError) or (isinstance(error, OSError) and error.errno is None)
    return is_from_loading and _NOT_LOADED.search(str(error)) is not None
