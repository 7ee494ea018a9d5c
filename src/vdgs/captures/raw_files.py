"""Raw photographs (DNG, and the formats of camera makers): size, tags, and pixels developed alike for all.

LibRaw develops them: the daylight white balance of the camera, no automatic exposure, highlights clipped, the curve of
sRGB. Nothing is fitted to a photograph, so that photographs of a flight differ only by what the sensor saw.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vdgs.captures.image_suffixes import RAW_SUFFIXES
from vdgs.captures.optional_decoders import require_decoder
from vdgs.captures.pillow_limits import pillow_without_limits
from vdgs.errors import CaptureError
from vdgs.system.permissions import refusal

_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*")
_XMP_TAG = 0x02BC
#: The curve of sRGB: exponent, and slope at black.
_SRGB_GAMMA = (2.4, 12.92)


def is_raw(path: Path) -> bool:
    """Whether a file is raw, by its suffix, and no JPEG by its first bytes."""
    if path.suffix.lower() not in RAW_SUFFIXES:
        return False
    try:
        with path.open("rb") as file:
            return file.read(2) != _JPEG
    except OSError:
        return True


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """LibRaw's view of a file. Raises CaptureError for what LibRaw cannot read."""
    rawpy = require_decoder("rawpy", path)
    try:
        path.open("rb").close()  # LibRaw does not say that it may not read a file
        with rawpy.imread(str(path)) as raw:
            yield raw
    except PermissionError as error:
        raise CaptureError(f"{path}: {refusal(path, error)}") from None
    except rawpy.LibRawError as error:
        said = error.args[0].decode(errors="replace") if isinstance(error.args[0], bytes) else error
        raise CaptureError(
            f"{path}: LibRaw cannot read the raw file ({said}). Copy it again, or develop it to TIFF or JPEG, with "
            "its tags, if other programs show it."
        ) from None


def raw_size(path: Path) -> tuple[int, int]:
    """Width and height as the sensor has them, before EXIF's orientation."""
    with _opened(path) as raw:
        return raw.sizes.width, raw.sizes.height


def raw_tags(path: Path) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any], bytes]:
    """EXIF's tags, those of the exposure and of GPS, and the XMP packet. Of formats that are no TIFF: those of the
    preview inside."""
    with path.open("rb") as file:
        head = file.read(4)
        if head in _TIFF:
            exif = Image.Exif()
            file.seek(0)
            exif.load_from_fp(file)
            return _tags_of(exif)
    rawpy = require_decoder("rawpy", path)
    try:
        with _opened(path) as raw:
            preview = raw.extract_thumb()
    except (rawpy.LibRawError, CaptureError):  # there is none: its pixels are still good
        return {}, {}, {}, b""
    if preview.format != rawpy.ThumbFormat.JPEG:
        return {}, {}, {}, b""
    with pillow_without_limits(), Image.open(io.BytesIO(preview.data)) as image:
        return _tags_of(image.getexif())


def _tags_of(exif: Image.Exif) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any], bytes]:
    packet = exif.get(_XMP_TAG, b"")
    packet = packet if isinstance(packet, bytes) else bytes(packet) if isinstance(packet, tuple) else b""
    return dict(exif), dict(exif.get_ifd(0x8769)), dict(exif.get_ifd(0x8825)), packet


def develop(path: Path) -> np.ndarray:
    """Pixels [h, w, 3] uint8 RGB in sRGB, as the sensor has them: EXIF's orientation is not applied."""
    with _opened(path) as raw:
        return raw.postprocess(
            gamma=_SRGB_GAMMA, no_auto_bright=True, adjust_maximum_thr=0.0, user_flip=0, output_bps=8
        )
