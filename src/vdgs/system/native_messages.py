"""Discards what image libraries print about files, past every logger: errors come as exceptions.

libjpeg and libpng write to the file descriptor of standard error. While at least one thread decodes, the descriptor
leads into a temporary file; afterwards the lines of others in this file are written to standard error.
"""

from __future__ import annotations

import os
import re
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

STDERR = 2
_THEIRS = re.compile(
    rb"^(Corrupt JPEG data|Premature end of JPEG|Invalid SOS parameters|Inconsistent progression sequence"
    rb"|Unknown Adobe color|Warning: unknown JFIF|Application transferred too|libpng (warning|error)).*\n?",
    re.MULTILINE,
)
_lock, _threads = threading.Lock(), 0
#: The real standard error, and the file that replaces it.
_redirected: tuple[int, IO[bytes]] | None = None


@contextmanager
def without_decoder_messages() -> Iterator[None]:
    """Around the decoding of an image file by OpenCV; threads may do so side by side."""
    global _threads, _redirected
    with _lock:
        _threads += 1
        if _threads == 1:
            _redirected = _redirect()
    try:
        yield
    finally:
        with _lock:
            _threads -= 1
            if _threads == 0 and _redirected is not None:
                _restore(*_redirected)
                _redirected = None


def _redirect() -> tuple[int, IO[bytes]] | None:
    """None where there is no standard error, or no room for a temporary file."""
    try:
        real = os.dup(STDERR)
    except OSError:
        return None
    try:
        caught = tempfile.TemporaryFile()  # noqa: SIM115  # closed by `_restore`
        os.dup2(caught.fileno(), STDERR, inheritable=True)
    except OSError:
        os.close(real)
        return None
    return real, caught


def _restore(real: int, caught: IO[bytes]) -> None:
    os.dup2(real, STDERR, inheritable=True)
    os.close(real)
    with caught:
        caught.seek(0)
        if others := _THEIRS.sub(b"", caught.read()):
            os.write(STDERR, others)
