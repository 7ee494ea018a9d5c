"""Pictures small enough that dozens fit into one HTML file."""

from __future__ import annotations

import base64
import io
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

#: Longest side in pixels, and bytes of one picture, at most. Twelve such pictures stay below 8 MB in base64.
LONGEST_SIDE_PX, MOST_BYTES = 1600, 400_000
#: What is tried, in turn, on a picture that comes out too large: its share of the longest side, JPEG quality.
REDUCTIONS = ((1.0, 85), (1.0, 72), (0.75, 72), (0.5, 72), (0.3, 60))


class PictureError(Exception):
    """A picture that cannot be read."""


@dataclass(frozen=True)
class Picture:
    """An encoded picture and its size in pixels."""

    content: bytes
    width: int
    height: int
    kind: str = "png"

    def data_uri(self) -> str:
        return f"data:image/{self.kind};base64,{base64.b64encode(self.content).decode('ascii')}"


def load_picture(path: Path) -> Picture:
    """A PNG file, reduced; drawings stay PNG (sharp lines), photographs become JPEG. Raises PictureError."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return reduced(image)
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        struct.error,
        zlib.error,
        Image.DecompressionBombError,
    ) as error:
        raise PictureError(str(error).replace(str(path), path.name)) from error


def reduced(image: Image.Image) -> Picture:
    """The picture within the bounds on side and bytes, on white where it is transparent."""
    flat = Image.new("RGB", image.size, "white")
    layer = image.convert("RGBA")
    flat.paste(layer, mask=layer)
    flat = _within(flat, LONGEST_SIDE_PX)
    drawing = _encoded(flat, "png")
    photograph = _encoded(flat, "jpeg", quality=REDUCTIONS[0][1])
    # JPEG smears the lines of drawings, so PNG may cost a little more before it loses.
    if len(drawing.content) <= min(MOST_BYTES, 2 * len(photograph.content)):
        return drawing
    for share, quality in REDUCTIONS:
        picture = _encoded(_within(flat, int(share * LONGEST_SIDE_PX)), "jpeg", quality=quality)
        if len(picture.content) <= MOST_BYTES:
            break
    return picture


def _within(image: Image.Image, longest: int) -> Image.Image:
    scale = longest / max(image.size)
    if scale >= 1:
        return image
    width, height = (max(1, round(side * scale)) for side in image.size)
    return image.resize((width, height), Image.Resampling.LANCZOS)


def _encoded(image: Image.Image, kind: str, **options: int) -> Picture:
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    return Picture(buffer.getvalue(), image.width, image.height, kind)
