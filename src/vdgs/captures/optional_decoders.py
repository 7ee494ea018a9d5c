"""Decoders of photographs that the extra `photos` installs: HEIC by pillow-heif, raw files by rawpy."""

from __future__ import annotations

import importlib
import importlib.util
from functools import cache
from pathlib import Path
from types import ModuleType

from vdgs.errors import CaptureError

#: What installs them.
INSTALL = "pip install 'vdgs[photos]'"
_PACKAGES = {"rawpy": "rawpy", "pillow_heif": "pillow-heif"}


@cache
def has_decoder(module: str) -> bool:
    """Whether a decoder is installed, without loading it."""
    return importlib.util.find_spec(module) is not None


def require_decoder(module: str, path: Path) -> ModuleType:
    """The decoder of a file. Raises CaptureError with what installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise CaptureError(f"{path}: needs {_PACKAGES[module]} to be read ({error}): {INSTALL}") from None


@cache
def _register_heif(path: Path) -> None:
    require_decoder("pillow_heif", path).register_heif_opener()


def prepare_heif(path: Path) -> None:
    """Let Pillow open a file that is HEIC or HEIF inside, whatever its name."""
    if is_heif(path):
        _register_heif(path)


def is_heif(path: Path) -> bool:
    """Whether a file is HEIC or HEIF by its first bytes. AVIF, which Pillow reads by itself, and CR3 are not."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
    except OSError:
        return False
    return head[4:8] == b"ftyp" and head[8:12] not in (b"avif", b"avis", b"crx ", b"qt  ", b"isom", b"mp42")
