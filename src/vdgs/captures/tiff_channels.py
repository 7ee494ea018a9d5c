"""What the channels of a picture are: which is transparency, and what TIFFs say of theirs before the pixels."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import Image, TiffImagePlugin, UnidentifiedImageError

from vdgs.captures.pillow_limits import pillow_without_limits

_BITS, _PHOTOMETRIC, _SAMPLES, _LARGEST, _PLANAR, _EXTRA = 0x0102, 0x0106, 0x0115, 0x0119, 0x011C, 0x0152
#: Channels of color by PhotometricInterpretation: gray, RGB, palette, CMYK, YCbCr, Lab.
_COLORS = {0: 1, 1: 1, 2: 3, 3: 1, 5: 4, 6: 3, 8: 3}
#: The largest value of 16 bits.
_WHITE = 65535
#: What ExtraSamples calls transparency; 0, or no word at all, is any other band, such as near infrared.
_ALPHAS = (1, 2)
#: By the first bytes of a TIFF: how many of them its reader takes; a BigTIFF has a longer head.
_HEADS = {b"II*\0": 8, b"MM\0*": 8, b"II+\0": 16, b"MM\0+": 16}
#: PlanarConfiguration of files that have their channels one behind the other, and bits that are read so too.
_ONE_BEHIND_THE_OTHER, _BYTE = 2, 8


def has_alpha_channel(image: Image.Image) -> bool:
    """Whether an open picture has transparency: of a TIFF only what its tags call so."""
    if image.format == "TIFF":
        return tiff_has_alpha(image.tag_v2)  # type: ignore[attr-defined]
    return "A" in image.getbands() or "transparency" in image.info


def tiff_has_alpha(tags: Mapping[int, Any]) -> bool:
    """Whether a TIFF has transparency, by its first directory."""
    return any(extra in _ALPHAS for extra in _numbers(tags.get(_EXTRA)))


def tiff_tags(file: BinaryIO) -> Mapping[int, Any]:
    """The first directory of a TIFF, of kinds that Pillow does not open too; empty for other files and damaged ones."""
    head = file.read(max(_HEADS.values()))
    size = _HEADS.get(head[:4])
    if size is None:
        return {}
    try:
        directory = TiffImagePlugin.ImageFileDirectory_v2(head[:size])
        file.seek(directory.next)
        directory.load(file)
        return dict(directory)
    except Exception:  # Pillow's parser raises many kinds on damaged files, of which decoders tell
        return {}


def _largest_value(tags: Mapping[int, Any]) -> int:
    """The value of white in 16 bits: 4095 where MaxSampleValue says so of a TIFF of 12 bits a pixel, or so; 65535 else.
    Other values than the largest of some bits are statistics of a picture, of which each has its own (TIFF 6.0)."""
    said = [value for value in _numbers(tags.get(_LARGEST)) if 255 < value < _WHITE and not value & (value + 1)]
    return max(said, default=_WHITE)


def as_tags_say(pixels: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Pixels as OpenCV decodes them; of a TIFF without a fourth channel that is no transparency, and of values whose
    white is below that of 16 bits brought up to it."""
    tags = tiff_tags(io.BytesIO(data.data)) if bytes(data[:4]) in _HEADS else {}
    if tags and pixels.ndim == 3 and pixels.shape[2] == 4 and not tiff_has_alpha(tags):
        pixels = np.ascontiguousarray(pixels[..., :3])
    white = _largest_value(tags)
    if pixels.dtype == np.uint16 and pixels.max() <= white < _WHITE:
        pixels = (pixels.astype(np.uint32) * _WHITE // white).astype(np.uint16)
    return pixels


def unused_channels(tags: Mapping[int, Any]) -> str:
    """What is used of a TIFF with more channels than colors and transparency; empty where all are."""
    number, colors = _count(tags), _COLORS.get(int(tags.get(_PHOTOMETRIC, -1)))
    if colors is None or number <= colors + tiff_has_alpha(tags):
        return ""
    return f"the first {f'{colors} ' if colors > 1 else ''}of {number} channels"


def why_no_picture(path: Path) -> str:
    """Why the channels of a TIFF are not read, and what to do; empty for those that are, and for other files. Decoders
    mix up channels of 16 bits that lie one behind the other, and say nothing."""
    try:
        with path.open("rb") as file:
            tags = tiff_tags(file)
    except OSError:  # whoever decodes it says so
        return ""
    number, bits = _count(tags), max(_numbers(tags.get(_BITS)), default=1)
    planar = tags.get(_PLANAR) == _ONE_BEHIND_THE_OTHER
    if number == 1 or (not (planar and bits > _BYTE) and _is_opened(path)):
        return ""
    behind = ", one behind the other" if planar else ""
    return (
        f"is a TIFF of {number} channels of {bits} bits{behind}: save red, green and blue alone, 8 bits each, pixel by "
        "pixel, all photographs scaled alike and with their tags; or one band, in files of their own"
    )


def _is_opened(path: Path) -> bool:
    """Whether Pillow knows channels as a file has them; other faults of a file are told by who decodes it."""
    try:
        with pillow_without_limits(), Image.open(path):
            return True
    except UnidentifiedImageError:
        return False
    except Exception:  # of many kinds
        return True


def _count(tags: Mapping[int, Any]) -> int:
    return max(_numbers(tags.get(_SAMPLES)), default=1)


def _numbers(value: object) -> list[int]:
    """The whole numbers of a tag, which holds one or several, or nonsense."""
    several = value if isinstance(value, tuple | list) else (value,)
    return [each for each in several if isinstance(each, int)]
