"""Pictures of a map for people: the hillshade, and a sheet with scale, north, extent and legend."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from vdgs.geometry.map_projection import MapProjection
from vdgs.rendering.ortho.geotiff import read_overview
from vdgs.rendering.ortho.pixel_grid import PixelGrid
from vdgs.rendering.ortho.tile_renderer import NODATA_COUNT, NODATA_HEIGHT
from vdgs.system.documents import MapMetadata
from vdgs.system.figure_style import INK, MUTED, VISIBILITY_CMAP, draw_titles, new_figure, style_axes, write_png
from vdgs.system.units import floor_to_nice_length
from vdgs.visibility.visibility_map import visibility_color_norm

#: The sun of a hillshade: from the upper left of the sheet, half way up, as on printed maps. That is so wherever north
#: is: lit from below, hills are taken for hollows.
AZIMUTH_DEG, ALTITUDE_DEG = 315.0, 45.0
#: Longest side of pictures, in pixels.
MAX_IMAGE_PX = 2400
_PANEL_PX = 1400
HEIGHT_CMAP = "terrain"


@dataclass(frozen=True)
class PreviewSheet:
    """What a sheet says beside its pictures."""

    name: str
    grid: PixelGrid
    placement: MapProjection
    metadata: MapMetadata


def hillshade(heights: Float[np.ndarray, "h w"], pixel_size: float) -> Float[np.ndarray, "h w"]:
    """Light on a surface (NaN where there is none), 0 to 1, for pixels of so many units; level ground has 0.71."""
    down, right = np.gradient(heights, pixel_size) if min(heights.shape) > 1 else (np.zeros_like(heights),) * 2
    # The normal is (-right, down, 1): rows run downwards; the azimuth counts from the top of the sheet.
    azimuth, altitude = np.radians(AZIMUTH_DEG), np.radians(ALTITUDE_DEG)
    sun = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    lit = (sun[2] - sun[0] * right + sun[1] * down) / np.sqrt(1 + right * right + down * down)
    return np.where(np.isfinite(heights), np.nan_to_num(lit, nan=sun[2]).clip(0, 1), np.nan)


def write_hillshade(dsm: Path, file: Path, grid: PixelGrid) -> None:
    """Gray relief with transparent holes, at most `MAX_IMAGE_PX` long."""
    heights, factor = _heights(dsm, MAX_IMAGE_PX)
    light = hillshade(heights, grid.gsd * factor)
    shown = np.isfinite(light)
    gray = (np.nan_to_num(light) * 255 + 0.5).astype(np.uint8)
    _write_bgra(np.dstack([gray, gray, gray, np.where(shown, 255, 0).astype(np.uint8)]), file)


def write_picture(orthophoto: Path, file: Path) -> None:
    """The orthophoto alone with transparent holes, at most `MAX_IMAGE_PX` long: what the report begins with."""
    red, green, blue, alpha = read_overview(orthophoto, MAX_IMAGE_PX)[0]
    _write_bgra(np.dstack([blue, green, red, alpha]), file)


def _write_bgra(picture: UInt8[np.ndarray, "h w 4"], file: Path) -> None:
    done, content = cv2.imencode(".png", np.ascontiguousarray(picture))
    assert done
    file.write_bytes(content.tobytes())


def write_preview(orthophoto: Path, dsm: Path, visibility: Path, file: Path, sheet: PreviewSheet) -> None:
    """Orthophoto, shaded heights and V side by side (above each other where the map is wide), each with its legend."""
    grid = sheet.grid
    x0, y0, x1, y1 = grid.bounds
    across, along = x1 - x0, y1 - y0
    scale = min(5.2 / across, 6.4 / along)
    width, height = max(across * scale, 2.6), max(along * scale, 2.2)
    figure, place = new_figure(3 * width + 4.9, height + 2.3)
    rgba = np.moveaxis(read_overview(orthophoto, _PANEL_PX)[0], 0, -1)
    heights, factor = _heights(dsm, _PANEL_PX)
    counts = read_overview(visibility, _PANEL_PX)[0][0]
    panels = [place(0.95 + k * (width + 1.1) - (0.35 if k else 0.0), 0.8, width, height) for k in range(3)]
    panels[0].imshow(rgba, extent=(x0, x1, y0, y1), interpolation="nearest")
    _draw_heights(figure, panels[1], heights, hillshade(heights, grid.gsd * factor), sheet)
    _draw_counts(figure, panels[2], counts, sheet)
    for axes, title in zip(panels, ("orthophoto", "surface and its heights", "training cameras, V"), strict=True):
        axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", facecolor="#f3f1ec")
        axes.set_title(title, fontsize=10, color=INK, loc="left")
        style_axes(axes)
        for axis, most in ((axes.xaxis, 3), (axes.yaxis, 5)):
            axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10]))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}".replace(",", " ")))
        axes.tick_params(labelsize=8)
    for axes in panels[1:]:
        axes.set_yticklabels([])
    east, north = ("easting", "northing") if sheet.placement.crs.startswith(("EPSG", "enu")) else ("x", "y")
    panels[0].set(xlabel=f"{east} ({sheet.placement.unit})", ylabel=f"{north} ({sheet.placement.unit})")
    metadata = sheet.metadata
    _scale_bar(panels[0], grid, sheet.placement, metadata["stretch"])
    _north(panels[0], grid, metadata["north_deg"])
    draw_titles(
        figure, sheet.name,
        f"{sheet.placement.name}; {grid.width} x {grid.height} pixels of {grid.gsd:g} {sheet.placement.unit}; "
        f"{metadata['model']} model, {metadata['training_cameras']} training photographs",
        f"Heights: {sheet.placement.height_reference}. Blank: nothing solid, or no photograph looks there.",
    )  # fmt: skip
    write_png(figure, file)


def _heights(dsm: Path, longest_px: int) -> tuple[Float[np.ndarray, "h w"], float]:
    values, factor = read_overview(dsm, longest_px)
    return np.where(values[0] == np.float32(NODATA_HEIGHT), np.nan, values[0]).astype(np.float64), factor


def _draw_heights(figure: Figure, axes: Axes, heights: np.ndarray, light: np.ndarray, sheet: PreviewSheet) -> None:
    x0, y0, x1, y1 = sheet.grid.bounds
    known = heights[np.isfinite(heights)]
    low, high = np.quantile(known, [0.005, 0.995]).tolist() if known.size else (0.0, 1.0)
    norm = Normalize(low, max(high, low + 1e-6))
    colors = matplotlib.colormaps[HEIGHT_CMAP](0.15 + 0.7 * norm(np.nan_to_num(heights, nan=low)).clip(0, 1))
    colors[..., :3] *= (0.25 + 0.75 * np.nan_to_num(light) / np.sin(np.radians(ALTITUDE_DEG))).clip(0, 1.2)[..., None]
    colors[..., 3] = np.isfinite(heights)
    axes.imshow(colors.clip(0, 1), extent=(x0, x1, y0, y1), interpolation="nearest")
    shown = matplotlib.colors.ListedColormap(matplotlib.colormaps[HEIGHT_CMAP](np.linspace(0.15, 0.85, 256)))
    _legend(figure, axes, ScalarMappable(norm, shown), f"height ({sheet.placement.unit})")


def _draw_counts(figure: Figure, axes: Axes, counts: np.ndarray, sheet: PreviewSheet) -> None:
    x0, y0, x1, y1 = sheet.grid.bounds
    known = counts != NODATA_COUNT
    top, norm = visibility_color_norm(counts[known]) if known.any() else (10, Normalize(0, 10))
    shown = np.ma.masked_array(np.minimum(counts, top), ~known)
    axes.imshow(shown, extent=(x0, x1, y0, y1), cmap=VISIBILITY_CMAP, norm=norm, interpolation="nearest")
    _legend(figure, axes, ScalarMappable(norm, VISIBILITY_CMAP), f"V, to {top}")


def _legend(figure: Figure, axes: Axes, colors: ScalarMappable, label: str) -> None:
    """A bar at the right of a panel."""
    box = axes.get_position()
    width = figure.get_figwidth()
    bar = figure.add_axes((box.x1 + 0.08 / width, box.y0, 0.1 / width, box.height * 0.6))
    legend = figure.colorbar(colors, cax=bar)
    legend.outline.set_visible(False)  # type: ignore[operator]
    legend.locator = MaxNLocator(5, integer=True)
    legend.update_ticks()
    legend.minorticks_off()
    bar.tick_params(labelsize=7, colors=MUTED, labelcolor=INK, length=2)
    bar.set_title(label, fontsize=7, color=INK, loc="left", pad=4)


def _scale_bar(axes: Axes, grid: PixelGrid, placement: MapProjection, stretch: float) -> None:
    """A round length on the ground of about a quarter of the map, on white; on the map it is `stretch` times as
    long."""
    x0, y0, x1, y1 = grid.bounds
    length = floor_to_nice_length((x1 - x0) / stretch / 4)
    drawn = length * stretch
    left, low, thick = x0 + 0.05 * (x1 - x0), y0 + 0.05 * (y1 - y0), 0.012 * (y1 - y0)
    for k, color in enumerate((INK, "white")):
        corner = (left + k * drawn / 2, low)
        axes.add_patch(matplotlib.patches.Rectangle(corner, drawn / 2, thick, fc=color, ec=INK, lw=0.8))
    axes.text(
        left + drawn / 2, low + 1.6 * thick, f"{length:g} {placement.unit}", ha="center", va="bottom", fontsize=8,
        color=INK, bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
    )  # fmt: skip


def _north(axes: Axes, grid: PixelGrid, north_deg: float | None) -> None:
    """An arrow to the north, which is not the top of every map; along y where nobody knows the north."""
    x0, y0, x1, y1 = grid.bounds
    across, along = x1 - x0, y1 - y0
    angle, half = np.radians(north_deg or 0.0), min(0.055 * along, 0.2 * across)
    ahead = half * np.array([np.sin(angle), np.cos(angle)])
    middle = np.array([x1 - 0.06 * across - abs(ahead[0]), y1 - 0.03 * along - half])
    axes.annotate(
        "y" if north_deg is None else "N", xy=tuple(middle + ahead), xytext=tuple(middle - ahead), ha="center",
        va="center", fontsize=9, fontweight="bold", color=INK,
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.2},
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5},
    )  # fmt: skip
