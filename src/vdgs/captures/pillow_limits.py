"""Pillow's own limits of pictures, which large photographs exceed, and how to do without them."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from PIL import Image


class _PillowLimits:
    """The limits of Pillow in this process, and how many callers, in whatever threads, do without them."""

    def __init__(self) -> None:
        self._lock, self._callers, self._restore = threading.Lock(), 0, ExitStack()

    def lift(self) -> None:
        with self._lock:
            self._callers += 1
            if self._callers == 1:
                self._restore.enter_context(warnings.catch_warnings())
                warnings.simplefilter("ignore")
                self._restore.callback(setattr, Image, "MAX_IMAGE_PIXELS", Image.MAX_IMAGE_PIXELS)
                Image.MAX_IMAGE_PIXELS = None

    def restore(self) -> None:
        with self._lock:
            self._callers -= 1
            if not self._callers:
                self._restore.close()


_PILLOW_LIMITS = _PillowLimits()


@contextmanager
def pillow_without_limits() -> Iterator[None]:
    """Pillow without its warnings and its limit of 89 megapixels (aerial cameras exceed it; ours is
    `image_files.MAX_IMAGE_PX`), in the whole process until the last that entered it, in whatever thread, has left.
    """
    _PILLOW_LIMITS.lift()
    try:
        yield
    finally:
        _PILLOW_LIMITS.restore()
