"""A minimal DNG: one Bayer mosaic without compression, the tags that the format requires, EXIF and GPS."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from support.flights import sexagesimal

#: XYZ to the colors of the sensor (DNG's ColorMatrix1, under D65).
CAMERA_FROM_XYZ = np.array([[0.9, -0.3, -0.1], [-0.4, 1.2, 0.2], [-0.1, 0.2, 0.6]])
_XYZ_FROM_SRGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
BLACK, WHITE = 256, 16000
_BYTE, _TEXT, _SHORT, _LONG, _RATIONAL, _SIGNED = 1, 2, 3, 4, 5, 10
_CODES = {_BYTE: "B", _SHORT: "H", _LONG: "I"}


def write_dng(file: Path, srgb: np.ndarray, orientation: int = 1, as_shot: tuple[float, ...] | None = None,
              lat_lon: tuple[float, float] | None = None, xmp: bytes = b"", exposure: float = 1.0) -> None:  # fmt: skip
    """A raw photograph that daylight's white balance develops to these pixels [h, w, 3] uint8, times `exposure`."""
    values = srgb / 255.0
    linear = exposure * np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    to_camera = CAMERA_FROM_XYZ @ _XYZ_FROM_SRGB
    white = to_camera.sum(axis=1)
    camera = (linear @ to_camera.T / white.max()).clip(0, 1)
    mosaic = camera[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = camera[::2, ::2, 0], camera[1::2, 1::2, 2]
    pixels = np.round(BLACK + mosaic * (WHITE - BLACK)).astype("<u2").tobytes()
    height, width = srgb.shape[:2]
    neutral = as_shot or tuple(white / white.max())
    tags: dict[int, tuple[int, Any]] = {
        254: (_LONG, [0]), 256: (_LONG, [width]), 257: (_LONG, [height]), 258: (_SHORT, [16]), 259: (_SHORT, [1]),
        262: (_SHORT, [32803]), 271: (_TEXT, "Maker"), 272: (_TEXT, "Drone"), 273: (_LONG, [8]),
        274: (_SHORT, [orientation]), 277: (_SHORT, [1]), 278: (_LONG, [height]), 279: (_LONG, [len(pixels)]),
        284: (_SHORT, [1]), 33421: (_SHORT, [2, 2]), 33422: (_BYTE, [0, 1, 1, 2]), 50706: (_BYTE, [1, 4, 0, 0]),
        50708: (_TEXT, "Maker Drone"), 50714: (_SHORT, [BLACK]), 50717: (_LONG, [WHITE]),
        50721: (_SIGNED, CAMERA_FROM_XYZ.ravel()), 50728: (_RATIONAL, neutral), 50778: (_SHORT, [21]),
    }  # fmt: skip
    if xmp:
        tags[700] = (_BYTE, list(xmp))
    details = {33434: (_RATIONAL, [0.002]), 36867: (_TEXT, "2026:06:01 10:00:00"), 37386: (_RATIONAL, [8.5])}
    body, start = pixels, 8 + len(pixels)
    for tag, directory in ((34665, details), (34853, _gps(lat_lon) if lat_lon else {})):
        if directory:
            tags[tag] = (_LONG, [start])
            body += _directory(directory, start)
            start = 8 + len(body)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"II*\0" + struct.pack("<I", start) + body + _directory(tags, start))


def _gps(place: tuple[float, float]) -> dict[int, tuple[int, Any]]:
    latitude, longitude = place
    parts = [sexagesimal(value) for value in place]
    return {
        1: (_TEXT, "S" if latitude < 0 else "N"), 2: (_RATIONAL, parts[0]),
        3: (_TEXT, "W" if longitude < 0 else "E"), 4: (_RATIONAL, parts[1]), 5: (_BYTE, [0]), 6: (_RATIONAL, [540.0]),
    }  # fmt: skip


def _directory(tags: dict[int, tuple[int, Any]], start: int) -> bytes:
    entries, extra = b"", b""
    after = start + 2 + 12 * len(tags) + 4
    for tag, (kind, values) in sorted(tags.items()):
        if kind == _TEXT:
            content, count = values.encode() + b"\0", len(values) + 1
        elif kind in (_RATIONAL, _SIGNED):
            pairs = [number for value in values for number in (round(float(value) * 1_000_000), 1_000_000)]
            content, count = struct.pack(f"<{len(pairs)}{'i' if kind == _SIGNED else 'I'}", *pairs), len(values)
        else:
            content, count = struct.pack(f"<{len(values)}{_CODES[kind]}", *values), len(values)
        if len(content) > 4:
            entries += struct.pack("<HHII", tag, kind, count, after + len(extra))
            extra += content + bytes(len(content) % 2)
        else:
            entries += struct.pack("<HHI", tag, kind, count) + content.ljust(4, b"\0")
    return struct.pack("<H", len(tags)) + entries + bytes(4) + extra
