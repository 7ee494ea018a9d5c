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
MAX_SIDE_PX, MAX_BYTES = 1600, 400_000
#: What is tried, in turn, on a picture that comes out too large: its share of the longest side, JPEG quality.
REDUCTIONS = ((1.0, 85), (1.0, 72), (0.75, 72), (0.5, 72), (0.3, 60))
#: What Pillow raises for a damaged file.
_READ_ERRORS = (OSError, ValueError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)


class ImageReadError(Exception):
    """An image that cannot be read."""


@dataclass(frozen=True)
class EmbeddedImage:
    """An encoded picture and its size in pixels."""

    content: bytes
    width: int
    height: int
    format: str = "png"

    def data_uri(self) -> str:
        return f"data:image/{self.format};base64,{base64.b64encode(self.content).decode('ascii')}"


def load_embedded_image(path: Path) -> EmbeddedImage:
    """A PNG file, reduced; drawings stay PNG (sharp lines), photographs become JPEG. Raises ImageReadError."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return reduce_image(image)
    except _READ_ERRORS as error:
        raise ImageReadError(str(error).replace(str(path), path.name)) from error


def reduce_image(image: Image.Image) -> EmbeddedImage:
    """The picture within the bounds on side and bytes, on white where it is transparent."""
    flat = Image.new("RGB", image.size, "white")
    layer = image.convert("RGBA")
    flat.paste(layer, mask=layer)
    flat = _fit_within(flat, MAX_SIDE_PX)
    drawing = _encode(flat, "png")
    photograph = _encode(flat, "jpeg", quality=REDUCTIONS[0][1])
    # JPEG smears the lines of drawings, so PNG may cost a little more before it loses.
    if len(drawing.content) <= min(MAX_BYTES, 2 * len(photograph.content)):
        return drawing
    for share, quality in REDUCTIONS:
        picture = _encode(_fit_within(flat, int(share * MAX_SIDE_PX)), "jpeg", quality=quality)
        if len(picture.content) <= MAX_BYTES:
            break
    return picture


def _fit_within(image: Image.Image, longest: int) -> Image.Image:
    scale = longest / max(image.size)
    if scale >= 1:
        return image
    width, height = (max(1, round(side * scale)) for side in image.size)
    return image.resize((width, height), Image.Resampling.LANCZOS)


def _encode(image: Image.Image, format_name: str, **options: int) -> EmbeddedImage:
    buffer = io.BytesIO()
    image.save(buffer, format=format_name, **options)
    return EmbeddedImage(buffer.getvalue(), image.width, image.height, format_name)
