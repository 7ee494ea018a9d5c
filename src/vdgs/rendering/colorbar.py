"""The legend below a map: what the colours mean, in a strip as wide as the picture.

Words that find no room are left out, so that a small picture has a small legend and never half a number.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from vdgs.evaluation.comparison_images import FAINT, INK, PAPER, load_font
from vdgs.rendering.scalar_maps import NO_DATA_COLOR, ColorScale

#: Type in pixels: a share of the picture's width between these.
_MIN_FONT_PX, _MAX_FONT_PX, _FONT_SHARE = 11, 26, 1 / 46
_NO_DATA_LABEL = "nothing drawn"


def add_colorbar(image: UInt8[np.ndarray, "h w 3"], scale: ColorScale) -> UInt8[np.ndarray, "tall w 3"]:
    """The picture with the legend of its colours below it; both together have an even number of rows."""
    return np.concatenate([image, draw_colorbar(scale, image.shape[1], image.shape[0])])


def draw_colorbar(scale: ColorScale, width: int, above: int) -> UInt8[np.ndarray, "rows w 3"]:
    """The strip for a picture of `width` and `above` rows: what is measured, a bar of colours, numbers."""
    size = int(np.clip(round(width * _FONT_SHARE), _MIN_FONT_PX, _MAX_FONT_PX))
    margin, bar = size // 2, size
    top = margin + round(1.35 * size)
    rows = top + bar + round(1.75 * size)
    strip = Image.new("RGB", (width, rows + (above + rows) % 2), PAPER)
    draw = ImageDraw.Draw(strip)
    _heading(draw, scale, width, margin, size)
    draw.line((0, 0, width, 0), FAINT)  # alpha is white where all is well
    left, right = margin, max(width - margin, margin + 1)
    across = np.linspace(scale.low, scale.high, right - left)
    strip.paste(Image.fromarray(scale.colorize(np.broadcast_to(across, (bar, right - left)))), (left, top))
    draw.rectangle((left - 1, top - 1, right, top + bar), outline=FAINT)
    _numbers(draw, scale, (left, right), top + bar, size)
    return np.asarray(strip)


def _heading(draw: ImageDraw.ImageDraw, scale: ColorScale, width: int, margin: int, size: int) -> None:
    """What is measured at the left; at the right, where there is room for it, what no colour stands for."""
    face = load_font(size)
    room = float(width - 2 * margin)
    title = next((each for each in scale.titles if face.getlength(each) <= room), "")
    draw.text((margin, margin), title, INK, face)
    patch = size + size // 2
    needed = face.getlength(_NO_DATA_LABEL) + patch
    if scale.has_nodata and room - face.getlength(title) - 2 * size >= needed:
        start = round(width - margin - needed)
        draw.rectangle((start, margin, start + size, margin + size), fill=NO_DATA_COLOR, outline=FAINT)
        draw.text((start + patch, margin), _NO_DATA_LABEL, INK, face)


def _numbers(draw: ImageDraw.ImageDraw, scale: ColorScale, bar: tuple[int, int], top: int, size: int) -> None:
    """The numbers below the bar, (left, right) in pixels: both ends first, then those that overlap no other."""
    face, (left, right) = load_font(size), bar
    taken: list[tuple[float, float]] = []
    for value, words in (scale.ticks[0], scale.ticks[-1], *scale.ticks[1:-1]):
        x = left + (value - scale.low) / (scale.high - scale.low) * (right - 1 - left)
        length = face.getlength(words)
        start = min(max(x - length / 2, left), right - length)
        if start < left or any(start < other[1] + size / 2 and other[0] < start + length + size / 2 for other in taken):
            continue
        taken.append((start, start + length))
        draw.line((round(x), top, round(x), top + size // 4), FAINT)
        draw.text((start, top + size // 3), words, INK, face)
