"""Pictures for people: photograph, render and error side by side; one sheet of all test views.

Everything is drawn with Pillow on white, with the font that matplotlib ships, so that a sheet looks
the same on every machine.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath

import cv2
import matplotlib as mpl
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from vdgs.errors import VdgsError
from vdgs.system.atomic_files import write_bytes

#: Mean absolute error per channel at the bright end of the color map: one scale for all views of all
#: runs, so that two pictures can be held side by side.
ERROR_LIMIT = 0.2
#: Perceptually uniform: equal steps of error look equal.
ERROR_CMAP = "inferno"
ERROR_LABEL = "absolute error (0 to 1)"
INK, FAINT, PAPER = (28, 30, 34), (120, 124, 130), (255, 255, 255)
#: Panels are shown between these widths; the renders themselves are saved untouched.
PANEL_MIN_PX, PANEL_MAX_PX = 320, 960
THUMBNAIL_PX = 300
_MAX_NAME_LENGTH = 120


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """One cell of the contact sheet: pictures [h', w', 3] uint8 already reduced, and what stands below."""

    name: str
    caption: str
    photograph: UInt8[np.ndarray, "h w 3"]
    render: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class Panel:
    """A picture at the size at which it is shown, its label above it at the left, figures at the right."""

    picture: Image.Image
    label: str
    metrics_text: str = ""


def absolute_error(
    image: UInt8[np.ndarray, "h w 3"], reference: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """Mean over the channels of |image - reference|, on the scale where white is 1."""
    return np.abs(image.astype(np.int16) - reference.astype(np.int16)).mean(axis=2) / 255.0


def colorize(values: Float[np.ndarray, "h w"], limit: float) -> UInt8[np.ndarray, "h w 3"]:
    """Values from 0 to `limit` (clipped) to colors; NaN becomes white."""
    table = (mpl.colormaps[ERROR_CMAP](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0 + 0.5).astype(np.uint8)
    known = ~np.isnan(values)
    levels = np.clip(np.where(known, values, 0.0) / limit, 0.0, 1.0) * 255.0 + 0.5
    picture = table[levels.astype(np.uint8)]
    picture[~known] = 255
    return picture


def draw_comparison(
    reference: UInt8[np.ndarray, "h w 3"],
    image: UInt8[np.ndarray, "h w 3"],
    title: str,
    metrics_text: str = "",
    mask: np.ndarray | None = None,
    limit: float = ERROR_LIMIT,
) -> Image.Image:
    """Photograph | render | error with its color bar. `metrics_text` stands beside the render's label;
    masked pixels of the error are white."""
    error = absolute_error(image, reference)
    if mask is not None:
        error = np.where(mask, error, np.nan)
    size = panel_size(reference.shape[1], reference.shape[0], PANEL_MIN_PX, PANEL_MAX_PX)
    photograph, render, errors = (resize(picture, size) for picture in (reference, image, colorize(error, limit)))
    row = [Panel(photograph, "photograph"), Panel(render, "render", metrics_text), Panel(errors, ERROR_LABEL)]
    return draw_panels(row, title, limit)


def draw_panels(panels: Sequence[Panel], title: str, limit: float) -> Image.Image:
    """Pictures of one size side by side under a title; the last is an error, its color bar stands at its right."""
    width, height = panels[0].picture.size
    count, unit = len(panels), max(12, width // 34)
    margin, gap, head = unit * 3 // 2, unit, unit * 9 // 2
    bar_width, ticks_width = unit, unit * 4
    canvas = Image.new(
        "RGB", (2 * margin + count * (width + gap) + bar_width + ticks_width, head + height + margin), PAPER
    )
    draw = ImageDraw.Draw(canvas)
    draw.text((margin, unit * 9 // 10), title, INK, load_font(unit * 11 // 10, bold=True))
    for column, panel in enumerate(panels):
        left = margin + column * (width + gap)
        canvas.paste(panel.picture, (left, head))
        draw.text((left, head - unit * 3 // 5), panel.label, FAINT, load_font(unit), anchor="ls")
        draw.text((left + width, head - unit * 3 // 5), panel.metrics_text, INK, load_font(unit), anchor="rs")
    _draw_colorbar(canvas, (margin + count * (width + gap), head, bar_width, height), limit, unit)
    return canvas


def draw_contact_sheet(cells: list[Thumbnail], title: str) -> Image.Image:
    """Cells in a grid, photograph above render, the name and the caption below each pair."""
    if not cells:
        raise ValueError("a contact sheet needs at least one view")
    columns = min(len(cells), max(1, round(np.sqrt(len(cells) * 1.9))))
    rows = -(-len(cells) // columns)
    width = max(cell.render.shape[1] for cell in cells)
    height = max(cell.render.shape[0] for cell in cells)
    gap, text, head, between = 18, 15, 64, 4
    cell_height = 2 * height + between + text * 2 + gap
    canvas = Image.new("RGB", (gap + columns * (width + gap), head + rows * cell_height), PAPER)
    draw = ImageDraw.Draw(canvas)
    draw.text(
        (gap, 14),
        _ellipsize(title, load_font(22, bold=True), float(canvas.width - 2 * gap)),
        INK,
        load_font(22, bold=True),
    )
    draw.text((gap, 42), "photograph above, render below", FAINT, load_font(13))
    for index, cell in enumerate(cells):
        left = gap + (index % columns) * (width + gap)
        top = head + (index // columns) * cell_height
        canvas.paste(Image.fromarray(cell.photograph), (left, top))
        canvas.paste(Image.fromarray(cell.render), (left, top + height + between))
        line = top + 2 * height + between + text // 3
        draw.text((left + width, line), cell.caption, INK, load_font(text - 2), anchor="ra")
        room = float(width - draw.textlength(cell.caption, load_font(text - 2)) - 10)
        draw.text((left, line), _ellipsize(cell.name, load_font(text - 2), room), FAINT, load_font(text - 2))
    return canvas


def make_thumbnail(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "small_h small_w 3"]:
    """The picture at the width of a contact sheet cell; a tall one is bounded by the same height."""
    scale = THUMBNAIL_PX / max(image.shape[1], image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return np.asarray(resize(image, size))


def panel_size(width: int, height: int, smallest: int, largest: int) -> tuple[int, int]:
    """The size nearest to the picture's own whose width is between the two."""
    wanted = min(max(width, smallest), largest)
    return wanted, max(1, round(height * wanted / width))


def resize(pixels: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Image.Image:
    """Reduced with a Lanczos filter, enlarged by repeating pixels (nothing is invented)."""
    image = Image.fromarray(pixels)
    if image.size == size:
        return image
    method = Image.Resampling.LANCZOS if size[0] < image.width else Image.Resampling.NEAREST
    return image.resize(size, method)


@cache
def load_font(size_px: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans as matplotlib ships it."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / name), size_px)


def _draw_colorbar(canvas: Image.Image, box: tuple[int, int, int, int], limit: float, unit: int) -> None:
    """A vertical bar (left, top, width, height), 0 at the foot, labeled at five places."""
    left, top, width, height = box
    ramp = np.broadcast_to(np.linspace(limit, 0.0, height)[:, None], (height, width))
    canvas.paste(Image.fromarray(colorize(ramp, limit)), (left, top))
    draw = ImageDraw.Draw(canvas)
    for tick in range(5):
        value = limit * tick / 4
        y = top + round((height - 1) * (1.0 - tick / 4))
        draw.line([(left + width, y), (left + width + unit // 3, y)], INK)
        anchor = {0: "ls", 4: "lt"}.get(tick, "lm")
        label = f"{value:.2f}" if tick < 4 else f"≥{value:.2f}"
        draw.text((left + width + unit // 2, y), label, INK, load_font(unit), anchor=anchor)


def _ellipsize(text: str, face: ImageFont.FreeTypeFont, room_px: float) -> str:
    """The text, or its two ends with an ellipsis where there is no room for all of it."""
    if face.getlength(text) <= room_px:
        return text
    for kept in range(len(text) - 1, 0, -1):
        short = f"{text[: kept // 2]}…{text[len(text) - (kept - kept // 2) :]}"
        if face.getlength(short) <= room_px:
            return short
    return "…"


def write_png(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Lossless RGB, atomically."""
    done, content = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise VdgsError(f"{path} cannot be encoded as PNG from an image of size {list(image.shape)}.")
    write_bytes(path, content.tobytes())


def unique_file_stems(names: Sequence[str]) -> list[str]:
    """One file name (without suffix) for each view name, in order, unique even where case is ignored.

    `a/b.jpg` becomes `a__b`; where that name is taken the suffix joins it (`a__b_jpg`), then a number.
    """
    taken: set[str] = set()
    stems = []
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        parts = [*path.parent.parts, path.stem]
        plain = "__".join(_safe(part) for part in parts if part.strip("/."))[-_MAX_NAME_LENGTH:] or "view"
        stem, number = plain, 2
        if stem.casefold() in taken and path.suffix:
            plain = stem = f"{plain}_{_safe(path.suffix[1:])}"
        while stem.casefold() in taken:
            stem, number = f"{plain}_{number}", number + 1
        taken.add(stem.casefold())
        stems.append(stem)
    return stems


def _safe(part: str) -> str:
    """Letters, digits and a few marks: no separators, drive letters or hidden files."""
    return re.sub(r"[^\w.\- ]", "_", part).strip(". ") or "_"
