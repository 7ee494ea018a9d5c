"""Colors of other spaces than sRGB brought to it: ICC profiles (Adobe RGB, Display P3, CMYK), and EXIF's Adobe RGB."""

from __future__ import annotations

import io
import struct
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageCms

from vdgs.captures.tiff_channels import has_alpha_channel

#: Values that differ by no more (of 255) are of the same space, computed otherwise.
_SAME = 4
#: EXIF's directory of interoperability, and what names Adobe RGB there.
_INTEROP_IFD, _ADOBE_RGB = 0xA005, "R03"
#: Primaries x, y of red, green and blue, and the exponent.
ADOBE_RGB = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)), 563 / 256
_D65 = (0.3127, 0.3290)
#: D50 in XYZ, which ICC profiles count from, and Bradford's matrix.
_D50 = np.array([0.9642, 1.0, 0.8249])
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_CMYK, _GRAYS = "CMYK", ("L", "LA", "1", "I;16", "I;16B", "I;16L", "I")


def foreign_space(image: Image.Image) -> str:
    """What the colors of a picture are in, where that is not sRGB: the name of its profile; empty where it is."""
    if image.mode in _GRAYS:
        return ""
    mode = _CMYK if image.mode == _CMYK else "RGB"
    name = _foreign(_profile_of(image), mode)
    return name or (_CMYK if mode == _CMYK else "")


def to_srgb(image: Image.Image) -> Image.Image:
    """The picture as 8-bit RGB in sRGB, RGBA where it has an alpha channel. Colors out of sRGB's gamut are clipped."""
    transparent = has_alpha_channel(image)
    profile, mode = _profile_of(image), _CMYK if image.mode == _CMYK else "RGB"
    colors = image if image.mode == mode else image.convert(mode)
    if _foreign(profile, mode):
        colors = ImageCms.applyTransform(colors, _transform(profile, mode)) or colors
    colors = colors.convert("RGB")
    if transparent:
        colors.putalpha(image.convert("RGBA").getchannel("A"))
    return colors


def _profile_of(image: Image.Image) -> bytes:
    """The ICC profile of a picture, or that of what its tags name; empty for none."""
    profile = image.info.get("icc_profile")
    if isinstance(profile, bytes) and profile:
        return profile
    if image.format in ("JPEG", "MPO", "TIFF"):
        interop = _interoperability(image.getexif()).get(1, "")
        if isinstance(interop, str) and interop.startswith(_ADOBE_RGB):
            return matrix_profile("Adobe RGB (1998)", *ADOBE_RGB)
    return b""


def _interoperability(exif: Image.Exif) -> dict[int, Any]:
    """EXIF's directory of interoperability; empty where there is none, for which Pillow before 13 raises KeyError."""
    try:
        return exif.get_ifd(_INTEROP_IFD)
    except KeyError:
        return {}


@lru_cache(16)
def _foreign(profile: bytes, mode: str) -> str:
    """The name of a profile that is for this mode and moves colors; empty for others, and for damaged ones."""
    if not profile:
        return ""
    try:
        known = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if known.profile.xcolor_space.strip() != mode:
            return ""
        name = (known.profile.profile_description or "a profile without a name").strip()
        if mode == _CMYK:
            _transform(profile, mode)
            return f"CMYK ({name})"
        steps = np.arange(0, 256, 17).astype(np.uint8)
        lattice = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(16, -1, 3)
        moved = np.asarray(ImageCms.applyTransform(Image.fromarray(lattice), _transform(profile, mode)))
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return ""
    return name if np.abs(moved.astype(int) - lattice).max() > _SAME else ""


@lru_cache(16)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform:
    return ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB"), mode, "RGB",
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC, flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )  # fmt: skip


@lru_cache(16)
def matrix_profile(name: str, primaries: tuple[tuple[float, float], ...], exponent: float) -> bytes:
    """An ICC profile of version 2 for RGB with these primaries, white D65 and one exponent."""

    def xyz(place: tuple[float, float]) -> np.ndarray:
        return np.array([place[0] / place[1], 1.0, (1 - place[0] - place[1]) / place[1]])

    white = xyz(_D65)
    columns = np.stack([xyz(place) for place in primaries], axis=1)
    columns = columns * np.linalg.solve(columns, white)
    gains = (_BRADFORD @ _D50) / (_BRADFORD @ white)
    columns = np.linalg.inv(_BRADFORD) @ np.diag(gains) @ _BRADFORD @ columns

    def numbers(values: np.ndarray) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *np.round(values * 65536).astype(int).tolist())

    text = name.encode("ascii") + b"\0"
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(exponent * 256)) + b"\0\0"
    described = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78)
    contents = {b"desc": described + bytes(-len(described) % 4), b"cprt": b"text\0\0\0\0CC0\0", b"wtpt": numbers(_D50)}
    contents |= {b"%cXYZ" % letter: numbers(column) for letter, column in zip(b"rgb", columns.T, strict=True)}
    contents |= {b"%cTRC" % letter: curve for letter in b"rgb"}
    table, body, start = struct.pack(">I", len(contents)), b"", 128 + 4 + 12 * len(contents)
    for tag, content in contents.items():
        table += tag + struct.pack(">II", start + len(body), len(content))
        body += content
    size = start + len(body)
    head = struct.pack(">I4sI4s4s4s", size, b"\0\0\0\0", 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", *np.round(_D50 * 65536).astype(int).tolist())
    return head + bytes(128 - len(head)) + table + body
