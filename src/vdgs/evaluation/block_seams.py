"""Evaluates what the cut into blocks gained and what its seams cost, with images of the worst seams.

OUTPUT/by_block.json    PSNR of each block: coarse, isolated (as trained), merged; errors at borders, interior
OUTPUT/seams/NAME.png   coarse | merged | merged with the borders of blocks | error, where borders show most
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int16, UInt8
from PIL import Image, ImageDraw
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from torch import Tensor

from vdgs.captures.capture import View
from vdgs.errors import RunError
from vdgs.evaluation import comparison_images
from vdgs.evaluation.by_block import (
    BORDER_PX,
    BlockMetrics,
    SeamMetrics,
    block_label_map,
    border_lines,
    border_pixels,
    visible_blocks,
)
from vdgs.evaluation.comparison_images import (
    ERROR_LABEL,
    ERROR_LIMIT,
    PANEL_MAX_PX,
    PANEL_MIN_PX,
    Panel,
    absolute_error,
    colorize,
    draw_panels,
    load_font,
    panel_size,
    resize,
    unique_file_stems,
)
from vdgs.evaluation.metric_tables import format_value
from vdgs.evaluation.metrics import masked_mean, psnr_from_mse, squared_error, to_8bit
from vdgs.evaluation.renderable_model import ReferenceViews
from vdgs.evaluation.view_exposures import apply_exposure_numpy
from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import Raster
from vdgs.partition.merging import BlockLookup
from vdgs.system.atomic_files import to_jsonable, write_json
from vdgs.system.documents import BlockMetricsDocument, JsonObject
from vdgs.system.stop_signals import check_stop_requested

#: Renders that are measured by block: without blocks, the block as it was trained, all blocks together.
RENDER_NAMES = ("coarse", "isolated", "merged")
#: Pictures drawn at most: the views with the most border pixels.
MAX_SEAM_VIEWS = 6
#: Borders of blocks and their numbers: bright on a dark rim, so that they show on any ground.
LINE_COLOR, OUTLINE_COLOR = (255, 236, 64), (20, 20, 20)


@dataclass(frozen=True, eq=False, kw_only=True)
class SeamView:
    """What the picture of a view shows: renders and photograph in 8 bits, the label of each pixel."""

    name: str
    stem: str
    coarse: UInt8[np.ndarray, "h w 3"]
    merged: UInt8[np.ndarray, "h w 3"]
    reference: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"] | None
    labels: Int16[np.ndarray, "h w"]
    #: Pixels near a border, those that the mask drops left out.
    border: Bool[np.ndarray, "h w"]

    @property
    def border_pixel_count(self) -> int:
        return int(np.count_nonzero(self.border))


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockInputs:
    """Where the images of a view come from. `render_merged` draws depth; the labels follow from the median one by
    `block_at`, which says of which of the `num_blocks` blocks the merged scene is made at a point.
    `render_block(index, camera)` is the image of a block as it was trained, among its frozen surroundings; None where
    it was not trained. All are measured in the exposure of the view, as in `RenderableModel`."""

    reference_views: ReferenceViews
    render_coarse: Callable[[Camera], Raster]
    render_merged: Callable[[Camera], Raster]
    render_block: Callable[[int, Camera], Raster | None]
    num_blocks: int
    block_at: BlockLookup
    exposure: Callable[[View], Float[Tensor, "3 4"]] | None = None

    def to_image(self, rendered: Raster, view: View) -> UInt8[np.ndarray, "h w 3"]:
        """What is measured of a render."""
        pixels = rendered.image.detach().cpu().numpy()
        return to_8bit(pixels if self.exposure is None else apply_exposure_numpy(pixels, self.exposure(view)))


@dataclass(frozen=True, eq=False)
class BlockViewMetrics:
    """What one view says of the blocks."""

    row: JsonObject
    by_block: BlockMetrics
    seams: SeamMetrics


def evaluate_blocks(inputs: BlockInputs, output: Path) -> BlockMetricsDocument:
    """Measure every test view, write `output`, and return what `by_block.json` holds. One view is in memory at a time,
    and the seam images. The figure of a block that was not trained is null. Raises RunError without views."""
    views = inputs.reference_views.views
    if not views:
        raise RunError(f"{output}: there are no test views. Hold some out when the capture is read.")
    measured, shown = list[BlockViewMetrics](), list[SeamView]()
    for view, stem in zip(views, unique_file_stems([view.name for view in views]), strict=True):
        check_stop_requested()
        figures, seam_view = measure_block_view(view, stem, inputs)
        measured.append(figures)
        shown.append(seam_view)
        shown = [shown[index] for index in select_seam_views([each.border_pixel_count for each in shown])]
    for each in shown:
        save_seam_image(output / "seams" / f"{each.stem}.png", each)
    return summarize_blocks(measured, inputs.num_blocks, output)


def select_seam_views(border_pixels: Sequence[int]) -> list[int]:
    """Which of the views are drawn, by the number of border pixels of each: those with most, the first of equals."""
    best = sorted(range(len(border_pixels)), key=lambda index: -border_pixels[index])[:MAX_SEAM_VIEWS]
    return [index for index in best if border_pixels[index]]


def save_seam_image(path: Path, view: SeamView) -> None:
    comparison_images.write_png(path, np.asarray(draw_seam_image(view)))


def summarize_blocks(per_view_metrics: Iterable[BlockViewMetrics], blocks: int, output: Path) -> BlockMetricsDocument:
    """Gather views, in their order, into what `by_block.json` holds, and write it: once its pictures are complete."""
    by_block, seams, rows = BlockMetrics(blocks, RENDER_NAMES), SeamMetrics(), list[JsonObject]()
    for figures in per_view_metrics:
        by_block.merge(figures.by_block)
        seams.merge(figures.seams)
        rows.append(figures.row)
    seam_figures = {"border_px": BORDER_PX, **seams.figures()}
    result: BlockMetricsDocument = to_jsonable(
        {"blocks": by_block.rows(), "all": by_block.overall(), "seams": seam_figures, "views": rows}
    )
    write_json(output / "by_block.json", result)
    return result


def measure_block_view(view: View, stem: str, inputs: BlockInputs) -> tuple[BlockViewMetrics, SeamView]:
    """Measure a view: its figures, and what a seam image of it shows."""
    by_block, seams = BlockMetrics(inputs.num_blocks, RENDER_NAMES), SeamMetrics()
    reference, mask = inputs.reference_views.load_image(view), inputs.reference_views.load_mask(view)
    drawn = inputs.render_merged(view.camera)
    labels = block_label_map(drawn, view.camera, inputs.block_at)
    coarse, merged = inputs.to_image(inputs.render_coarse(view.camera), view), inputs.to_image(drawn, view)
    squared = {"coarse": squared_error(coarse, reference), "merged": squared_error(merged, reference)}
    isolated = _isolated_errors(view, labels, reference, inputs)
    by_block.add(labels, squared | {"isolated": isolated}, mask)
    errors = {f"mse_{name}": values for name, values in squared.items()}
    errors |= {"mae_coarse": absolute_error(coarse, reference), "mae_merged": absolute_error(merged, reference)}
    seams.add(labels, errors, mask)
    border = border_pixels(labels) if mask is None else border_pixels(labels) & mask
    seam_view = SeamView(
        name=view.name, stem=stem, coarse=coarse, merged=merged, reference=reference, mask=mask, labels=labels,
        border=border,
    )  # fmt: skip
    row = {
        "name": view.name,
        "border_pixels": seam_view.border_pixel_count,
        **{f"psnr_{name}": psnr_from_mse(masked_mean(values, mask)) for name, values in squared.items()},
        **{f"psnr_{name}_border": _psnr_within(values, border) for name, values in squared.items()},
    }
    return BlockViewMetrics(row, by_block, seams), seam_view


def _psnr_within(values: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]) -> float | None:
    return psnr_from_mse(float(values[where].mean())) if where.any() else None


def _isolated_errors(
    view: View, labels: Int16[np.ndarray, "h w"], reference: UInt8[np.ndarray, "h w 3"], inputs: BlockInputs
) -> Float[np.ndarray, "h w"]:
    """Squared error of each block's own render where the block is shown, NaN where there is none."""
    errors = np.full(labels.shape, np.nan)
    for index in visible_blocks(labels, inputs.num_blocks):
        rendered = inputs.render_block(index, view.camera)
        if rendered is not None:
            own = labels == index
            errors[own] = squared_error(inputs.to_image(rendered, view), reference)[own]
    return errors


def draw_seam_image(view: SeamView) -> Image.Image:
    """Coarse | merged | merged with the borders of blocks | error of the merged render, labeled."""
    height, width = view.labels.shape
    size = panel_size(width, height, PANEL_MIN_PX, PANEL_MAX_PX)
    error = absolute_error(view.merged, view.reference)
    if view.mask is not None:
        error = np.where(view.mask, error, np.nan)
    panels = [
        Panel(resize(view.coarse, size), "coarse", _caption(view.coarse, view)),
        Panel(resize(view.merged, size), "merged", _caption(view.merged, view)),
        Panel(draw_block_borders(view.merged, view.labels, size), "borders of blocks"),
        Panel(resize(colorize(error, ERROR_LIMIT), size), f"merged: {ERROR_LABEL}"),
    ]
    return draw_panels(panels, view.name, ERROR_LIMIT)


def _caption(image: UInt8[np.ndarray, "h w 3"], view: SeamView) -> str:
    errors = squared_error(image, view.reference)
    near = _psnr_within(errors, view.border)
    return f"{psnr_from_mse(masked_mean(errors, view.mask)):.2f} dB, near borders {format_value(near, '{:.2f}')}"


def draw_block_borders(
    image: UInt8[np.ndarray, "h w 3"], labels: Int16[np.ndarray, "h w"], size: tuple[int, int]
) -> Image.Image:
    """The picture at `size` (width, height) with thin lines between blocks and the number of each block."""
    shown_labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    lines = border_lines(shown_labels)
    rim = cv2.dilate(lines.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    pixels = np.asarray(resize(image, size)).copy()
    pixels[rim], pixels[lines] = OUTLINE_COLOR, LINE_COLOR
    drawn = Image.fromarray(pixels)
    draw, face = ImageDraw.Draw(drawn), load_font(max(12, size[0] // 34), bold=True)
    for index in visible_blocks(shown_labels, int(shown_labels.max(initial=-1)) + 1):
        position = _label_position(shown_labels == index)
        draw.text(position, str(index), LINE_COLOR, face, anchor="mm", stroke_width=2, stroke_fill=OUTLINE_COLOR)
    return drawn


def _label_position(region: Bool[np.ndarray, "h w"]) -> tuple[int, int]:
    """x, y of the pixel farthest from the region's edge and from the edge of the picture."""
    padded = np.pad(region.astype(np.uint8), 1)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    row, column = divmod(int(distance.argmax()), region.shape[1])
    return column, row


def make_block_table(result: Mapping[str, Any]) -> RenderableType:
    """What `by_block.json` holds, for the console."""
    table = Table(box=box.SIMPLE_HEAD, title="PSNR (dB) by block, over test pixels", title_justify="left")
    for column in ("block", "pixels", *RENDER_NAMES, "merged − coarse"):
        table.add_column(column, justify="right")
    for row in result["blocks"]:
        table.add_row(str(row["block"]), *_cells(row))
    table.add_section()
    table.add_row("all", *_cells(result["all"]))
    return Group(table, Text(_seam_line(result["seams"]), style="dim"))


def _cells(row: Mapping[str, Any]) -> list[str]:
    coarse, isolated, merged = (row[f"psnr_{name}"] for name in RENDER_NAMES)
    gain = None if coarse is None or merged is None else merged - coarse
    values = [format_value(each, "{:.2f}") for each in (coarse, isolated, merged)]
    return [f"{row['pixels']:,}", *values, format_value(gain, "{:+.2f}")]


def _seam_line(seams: Mapping[str, Any]) -> str:
    if not seams["border_pixels"]:
        return "no border between blocks is in sight"
    coarse, merged = (format_value(seams[f"mae_{name}"]["ratio"], "{:.3f}") for name in SeamMetrics.RENDER_NAMES)
    return (
        f"error within {seams['border_px']:.0f} px of a border over error in the interior: merged {merged}, "
        f"coarse {coarse} (which has no seams); merged over coarse {format_value(seams['seam_mae_ratio'], '{:.3f}')}"
    )
