"""Discards what image libraries say about files on their own: errors come as exceptions, and are said in our words.

libjpeg, libpng and OpenCV write to the file descriptor of standard error. While at least one thread decodes, the
descriptor leads into a temporary file; afterwards the lines of others in this file are written to standard error.
"""

from __future__ import annotations

import os
import re
import tempfile
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

STDERR = 2
_THEIRS = re.compile(
    rb"^(Corrupt JPEG data|Premature end of JPEG|Invalid SOS parameters|Inconsistent progression sequence"
    rb"|Unknown Adobe color|Warning: unknown JFIF|Application transferred too|libpng (warning|error)"
    rb"|\[ ?(WARN|ERROR):\S*\] global ).*\n*",  # OpenCV, of files
    re.MULTILINE,
)
_lock, _threads = threading.Lock(), 0
#: The real standard error, and the file that replaces it.
_redirected: tuple[int, IO[bytes]] | None = None


def quiet_libraries() -> None:
    """Let Pillow and matplotlib's fonts not warn and OpenCV not log in this process, nor OpenCV in its children, unless
    OPENCV_LOG_LEVEL asks for it. For processes of vdgs alone, before OpenCV is imported: others set that themselves."""
    warnings.filterwarnings("ignore", module=r"PIL\.")
    # Names in scripts that the font lacks are drawn as boxes, without a line of source for each letter.
    warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from font")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")


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
