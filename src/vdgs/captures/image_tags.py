"""What the file of a photograph says before its pixels, whatever its kind: size, EXIF, GPS, XMP, colors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from vdgs.captures.color_profiles import foreign_space
from vdgs.captures.image_files import mode_of, open_image
from vdgs.captures.jpeg import JPEGS, has_end
from vdgs.captures.raw_files import is_raw, raw_size, raw_tags
from vdgs.captures.tiff_channels import has_alpha_channel, unused_channels
from vdgs.captures.tiff_orientation import stored_size
from vdgs.captures.xmp_packets import exif_of, xmp_of

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_BITS_PER_SAMPLE = 0x0102
#: Pillow's formats that all programs read, COLMAP's decoder among them, and the compressions of TIFF that every build
#: of libtiff has. Of others COLMAP finds nothing, or reads black.
_COMMON_FORMATS = ("JPEG", "MPO", "PNG", "BMP", "TIFF")
_COMMON_COMPRESSIONS = ("raw", "packbits", "tiff_lzw", "tiff_deflate", "tiff_adobe_deflate", "jpeg")
#: What radiometric JPEGs keep temperatures in: FLIR's segments, and the parameters of DJI's by their first bytes, or
#: those behind a head.
_FLIR, _DJI, _DJI_BEHIND = b"FLIR\0", b"\xaa\x55\x12\x06", b"\xaa\x55\x38\x00"
_DJI_HEAD_BYTES = 32
_NAMES = {"HEIF": "HEIC", "WEBP": "WebP"}


@dataclass(frozen=True, kw_only=True)
class ImageTags:
    """Of a file as it is, before EXIF's orientation."""

    width: int
    height: int
    mode: str
    """Pillow's; RGB for raw files."""
    tags: dict[int, Any]
    """EXIF's first directory, and those of the exposure and of GPS."""
    details: dict[int, Any]
    gps: dict[int, Any]
    xmp_packet: bytes
    """All packets, one behind the other."""
    has_alpha_channel: bool
    whole: bool
    """False for a JPEG without an end marker."""
    kind: str
    """What makes it other than 8-bit sRGB in a file that all programs read: HEIC, WebP, raw, CMYK, Display P3, 16 bits
    a channel, more channels than colors; empty for what is."""
    has_temperatures: bool = False
    """Whether it is a radiometric JPEG of a thermal camera."""


def read_tags(path: Path) -> ImageTags:
    """Raises what Pillow raises for files that are damaged or no image, and CaptureError for raw files and decoders
    that are not installed."""
    if is_raw(path):
        width, height = raw_size(path)
        tags, details, gps, packet = raw_tags(path)
        return ImageTags(
            width=width, height=height, mode="RGB", tags=tags, details=details, gps=gps, xmp_packet=packet,
            has_alpha_channel=False, whole=True, kind="raw",
        )  # fmt: skip
    with open_image(path) as image:
        kind, exif = _kind(image), exif_of(image)  # of a PNG, the latter forgets how its pixels lie
        width, height = stored_size(image)
        return ImageTags(
            width=width,
            height=height,
            mode=mode_of(image),
            tags=dict(exif),
            details=dict(exif.get_ifd(_EXIF_IFD)),
            gps=dict(exif.get_ifd(_GPS_IFD)),
            xmp_packet=xmp_of(image),
            has_alpha_channel=has_alpha_channel(image),
            whole=image.format not in JPEGS or has_end(path, image),
            kind=kind,
            has_temperatures=_has_temperatures(image),
        )


def may_be_transparent(path: Path) -> bool:
    """`ImageTags.has_alpha_channel` of a file whose head can be read."""
    if is_raw(path):
        return False
    with open_image(path) as image:
        return has_alpha_channel(image)


def kind_of(path: Path) -> str:
    """`ImageTags.kind` of a file whose head can be read."""
    if is_raw(path):
        return "raw"
    with open_image(path) as image:
        return _kind(image)


def _kind(image: Image.Image) -> str:
    space = foreign_space(image)
    colors = space or ("16 bits a channel" if _has_16_bits(image) else "")
    channels = unused_channels(image.tag_v2) if image.format == "TIFF" else ""  # type: ignore[attr-defined]
    return ", ".join(filter(None, (_uncommon_format(image), channels, colors)))


def _has_temperatures(image: Image.Image) -> bool:
    segments = [(marker, bytes(content[: _DJI_HEAD_BYTES + 4])) for marker, content in getattr(image, "applist", ())]
    return any(
        (marker == "APP1" and head.startswith(_FLIR))
        or (marker == "APP4" and (head.startswith(_DJI) or head[_DJI_HEAD_BYTES:] == _DJI_BEHIND))
        for marker, head in segments
    )


def _uncommon_format(image: Image.Image) -> str:
    """The format by its content, whatever its name ends in, where not all programs read it."""
    found = image.format or ""
    if found not in _COMMON_FORMATS:
        return _NAMES.get(found, found)
    compression = str(image.info.get("compression", "raw")) if found == "TIFF" else "raw"
    return "" if compression in _COMMON_COMPRESSIONS else f"TIFF compressed by {compression.removeprefix('tiff_')}"


def _has_16_bits(image: Image.Image) -> bool:
    if image.format == "TIFF":
        return 16 in image.tag_v2.get(_BITS_PER_SAMPLE, ())  # type: ignore[attr-defined]
    return image.format == "PNG" and any("16" in str(tile[3]) for tile in getattr(image, "tile", ()))
