"""What the pixels of a picture tell of the camera: gray, false color of a thermal one, or the colors of eyes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from vdgs.captures.image_files import open_image
from vdgs.errors import CaptureError

#: Pillow's modes of gray.
GRAYS = ("L", "I;16", "I;16B", "I;16L")
#: Of gray stored as color, channels differ by no more (levels), but for marks in color (a spot, a cross, a logo: choice
#: of the share), in the small picture that is looked at (pixels).
_GRAY, _GRAY_SHARE, _LOOKED_AT = 4, 0.95, (128, 128)
#: Of false color, levels scatter no more along its palette than so much of the whole. Measured: palettes as JPEG 0.04
#: to 0.20, photographs 0.32 to 1.
_ON_CURVE = 0.25
#: Less color, or less contrast, tells nothing (levels, standard deviation).
_LEAST_SPREAD = 10.0
#: Hues are compared where so much of a picture has color: a distance of so many levels from gray.
_COLORED, _LEAST_CHROMA = 0.8, 10.0
_LEVELS, _HUES = 24, 48


def shows_gray(path: Path) -> bool:
    """Whether a picture shows gray, but for marks, by some of its pixels, though it may be stored in color."""
    colors = _small(path)
    return colors is not None and _is_gray(colors)


def looks_visible(path: Path) -> bool:
    """Whether a picture shows the colors of eyes for sure: it is neither gray, nor of few colors or little
    contrast, nor in the false color of a palette. False for one that cannot be looked at.

    The colors of a palette lie on one curve. Along it, brightness tells the color (iron), or the hue tells the
    brightness (rainbow); in photographs neither does.
    """
    colors = _small(path)
    if colors is None or _is_gray(colors):
        return False
    light, *chroma = np.asarray(Image.fromarray(colors).convert("YCbCr"), np.float64).reshape(-1, 3).T - 128
    blue, red = chroma
    if min(light.std(), float(np.sqrt(np.var(chroma, axis=1).sum()))) < _LEAST_SPREAD:
        return False
    if _follows(np.stack(chroma, 1), light, _LEVELS):
        return False
    colored = np.hypot(blue, red) > _LEAST_CHROMA
    hue = np.arctan2(red, blue)
    return bool(colored.mean() <= _COLORED) or not _follows(light[colored, None], hue[colored], _HUES)


def _small(path: Path) -> np.ndarray | None:
    """Some pixels of a picture, red, green and blue of 8 bits; None for raw files and what cannot be read."""
    try:
        with open_image(path) as image:
            if image.mode in GRAYS:
                return np.zeros((*_LOOKED_AT, 3), np.uint8)
            image.draft("RGB", _LOOKED_AT)
            return np.asarray(image.convert("RGB").resize(_LOOKED_AT, Image.Resampling.NEAREST))
    except (CaptureError, OSError, SyntaxError, ValueError):
        return None


def _is_gray(colors: np.ndarray) -> bool:
    return bool((np.ptp(colors, axis=2) <= _GRAY).mean() >= _GRAY_SHARE)


def _follows(values: np.ndarray, along: np.ndarray, bins: int) -> bool:
    """Whether values [n, k] hardly scatter where a quantity [n] is the same."""
    edges = np.linspace(along.min(), along.max(), bins + 1)[1:-1]
    label = np.digitize(along, edges)
    number = np.maximum(np.bincount(label, minlength=bins), 1)
    scatter = [np.mean((each - (np.bincount(label, each, bins) / number)[label]) ** 2) for each in values.T]
    spread = float(np.sqrt(values.var(axis=0).sum()))
    return spread >= _LEAST_SPREAD and float(np.sqrt(sum(scatter))) <= _ON_CURVE * spread
