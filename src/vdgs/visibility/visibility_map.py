"""The map from above that shows how often each place is seen, with the histogram of V beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter
from scipy.ndimage import binary_closing, binary_opening, gaussian_filter, label

from vdgs.geometry.camera import Camera
from vdgs.system import figure_style as style
from vdgs.system.figure_style import ACCENT, INK, NOTE_SIZE, TEXT_SIZE, VISIBILITY_CMAP, style_axes
from vdgs.visibility.visibility_counts import LOW_VISIBILITY_LIMITS, count_visibility

GRID_CELLS = 240
#: Islands and holes of a smaller share of the map have no border.
MIN_PATCH_SHARE = 0.001
#: Points are thinned to so many, evenly over V: of more, they cover each other, and drawing takes minutes.
MAX_DRAWN_POINTS = 400_000
#: Width in points of the border.
BORDER_LINE_WIDTH = 0.9


@dataclass(frozen=True, eq=False)
class CameraMarks:
    """Cameras to be marked alike: triangles with a face and an edge, `size` in points²."""

    label: str
    cameras: Sequence[Camera]
    face: str
    edge: str
    size: float = 30.0


@dataclass(frozen=True, eq=False, kw_only=True)
class VisibilityMapData:
    """What a map of V shows: points colored by V, marked cameras, and (pale) V on level ground."""

    points: Float[np.ndarray, "n 3"]
    #: V of the points: how many of the cameras of `marks[0]` hold each in their frustum.
    visibility: Int[np.ndarray, " n"]
    #: The corners of the map.
    low: Float[np.ndarray, " 2"]
    high: Float[np.ndarray, " 2"]
    #: z of the level ground.
    ground: float
    marks: Sequence[CameraMarks]
    #: What x and y are called, with their unit.
    x_label: str
    y_label: str
    #: What a point is, in the singular and with its article.
    noun: str
    #: A bold line, a line of facts, and a line about the colors.
    titles: tuple[str, str, str]


def plot_visibility_map(file: Path, data: VisibilityMapData) -> None:
    """Points and cameras from above, points colored by V; beside it the histogram of V. Writes a PNG."""
    width, height = map_size_inches(data.low, data.high)
    figure, place = style.new_figure(width + 4.7, height + 2.05)
    axes = place(0.85, 0.65, width, height)
    top, norm = visibility_color_norm(data.visibility)
    bordered = _ground(axes, data, norm)
    order = np.argsort(-data.visibility, kind="stable")  # the poorly seen on top, so that none is hidden
    order = order[:: -(-len(order) // MAX_DRAWN_POINTS) or 1]
    size, (x, y) = float(np.clip(6e4 / max(len(order), 1), 0.5, 7.0)), data.points[order, :2].T
    colors = np.minimum(data.visibility[order], top)
    axes.scatter(x, y, size, colors, cmap=VISIBILITY_CMAP, norm=norm, linewidths=0)
    _cameras(axes, data.marks)
    _legend(figure, axes, bordered)
    (x0, y0), (x1, y1) = data.low, data.high
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel=data.x_label, ylabel=data.y_label)
    start = 0.85 + width + 0.75
    bar, histogram = place(start, 0.65, 0.2, height), place(start + 0.24, 0.65, 2.3, height)
    _histogram(bar, histogram, data.visibility, top, norm, data.noun)
    style_axes(axes)
    style.draw_titles(figure, *data.titles)
    style.write_png(figure, file)


def _ground(axes: Axes, data: VisibilityMapData, norm: Normalize) -> bool:
    """Pale V on the level ground, and the border of where it is at least 3, also where there are no points. Returns
    whether there is such a border."""
    (x0, y0), (x1, y1), cameras = data.low, data.high, data.marks[0].cameras
    x, y = np.linspace(x0, x1, GRID_CELLS), np.linspace(y0, y1, GRID_CELLS)
    grid = np.stack([*np.meshgrid(x, y), np.full((GRID_CELLS, GRID_CELLS), data.ground)], axis=-1)
    field = count_visibility(torch.from_numpy(grid.reshape(-1, 3)), cameras).numpy().reshape(GRID_CELLS, GRID_CELLS)
    ground, colors = np.ma.masked_equal(field, 0), VISIBILITY_CMAP
    axes.imshow(
        ground, colors, norm, alpha=0.22, origin="lower", extent=(x0, x1, y0, y1), interpolation="nearest", zorder=0
    )
    covered = remove_speckles(field >= LOW_VISIBILITY_LIMITS[0])
    if covered.all() or not covered.any():
        return False
    smooth = gaussian_filter(covered.astype(np.float64), 1.0, mode="nearest")
    axes.contour(x, y, smooth, levels=[0.5], colors=INK, linewidths=BORDER_LINE_WIDTH, zorder=1)
    return True


def remove_speckles(covered: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A map without slits and tongues narrower than three cells, and without islands and holes of less than
    `MIN_PATCH_SHARE` of it: a border around each would be ink and no news."""
    around = np.ones((3, 3), bool)
    wide = np.pad(covered, 4, mode="edge")  # beyond the map is what its edge shows
    wide = binary_opening(binary_closing(wide, around), around)[4:-4, 4:-4]
    for kind in (True, False):
        patches, _ = label(wide == kind)
        small = np.bincount(patches.ravel()) < MIN_PATCH_SHARE * wide.size
        small[0] = False  # what is of the other kind
        wide = wide ^ small[patches]
    return wide


def _cameras(axes: Axes, marks: Sequence[CameraMarks]) -> None:
    for mark in marks:
        centers = np.array([camera.position for camera in mark.cameras]).reshape(-1, 3)
        draw_triangles(axes, centers[:, :2], mark.size, mark.face, mark.edge, zorder=3, label=mark.label)


def draw_triangles(axes: Axes, xy: np.ndarray, size: float, face: str, edge: str, **options: Any) -> None:
    """Marks of `size` points², whose edge does not cover them."""
    width, (x, y) = min(0.8, 0.15 * size**0.5), xy.T
    axes.scatter(x, y, size, marker="^", linewidths=width, facecolors=face, edgecolors=edge, **options)


def _legend(figure: Figure, axes: Axes, bordered: bool) -> None:
    """One line between the titles and the map."""
    handles, _ = axes.get_legend_handles_labels()
    label = f"border of V ≥ {LOW_VISIBILITY_LIMITS[0]} on level ground"
    border = Line2D([], [], color=INK, linewidth=BORDER_LINE_WIDTH, label=label)
    width, height = figure.get_size_inches()
    figure.legend(
        handles=[*handles, border] if bordered else handles, loc="upper left", ncols=3, fontsize=NOTE_SIZE,
        bbox_to_anchor=(0.85 / width, 1 - 1.13 / height), handletextpad=0.4, columnspacing=1.2, borderaxespad=0,
        borderpad=0.1, frameon=False,
    )  # fmt: skip


def _histogram(bar: Axes, axes: Axes, visibility: np.ndarray, top: int, norm: Normalize, noun: str) -> None:
    """The color scale, and growing out of it the histogram of V; the last step holds all above it."""
    levels, limit, extent = np.arange(top + 1), LOW_VISIBILITY_LIMITS[0], (0, 1, -0.5, top + 0.5)
    bar.imshow(levels[:, None], VISIBILITY_CMAP, norm, origin="lower", extent=extent, aspect="auto")
    bar.set_xticks([])
    step = max(1, round(top / 10))
    ticks = [level for level in levels[::step] if level < top - step / 2] + [top]
    last = f"≥ {top}" if visibility.max() > top else str(top)
    bar.set_yticks(ticks, [*map(str, ticks[:-1]), last])
    bar.set_ylabel(f"training cameras that see {noun}, V", labelpad=2)
    shares = np.bincount(np.minimum(visibility, top), minlength=top + 1) / len(visibility)
    filled = levels[shares > 0]  # thousands of bars take seconds
    axes.barh(filled, shares[filled], height=0.86, color=VISIBILITY_CMAP(norm(filled)))
    median = min(float(np.median(visibility)), top)
    axes.plot([0, 1.12 * shares.max()], [median, median], color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.text(1.12 * shares.max(), median, " median", va="center", fontsize=NOTE_SIZE, color=INK)
    below, start = float((visibility < limit).mean()), shares[:limit].max() + 0.03 * shares.max()
    text = f" {below:.1%} below {limit}"
    note = axes.text(start, 1, text, va="center", fontsize=TEXT_SIZE, fontweight="bold", color=ACCENT)
    x_label = f"share of the {noun.split()[-1]}s"
    axes.set(ylim=(-0.5, top + 0.5), xlim=(0, 1.4 * shares.max()), yticks=[], xlabel=x_label)
    if note.get_window_extent().x1 > axes.figure.bbox.x1:  # too long beside the longest bar
        note.set_text(f" {below:.1%}\n below {limit}")
    axes.xaxis.set_major_locator(MaxNLocator(4))
    percents = 100 * axes.get_xticks()
    decimals = next((digits for digits in (0, 1) if np.allclose(percents, np.round(percents, digits))), 2)
    axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=decimals))
    for part in (bar, axes):
        style_axes(part)
        part.spines[:].set_visible(False)
    bar.tick_params(axis="y", length=0)


def visibility_color_norm(visibility: np.ndarray) -> tuple[int, Normalize]:
    """The greatest V that has a color of its own, and integer color steps from 0 to it.

    The 99 % quantile: a few points that very many cameras see must not flatten the rest.
    """
    top = max(int(np.quantile(visibility, 0.99)), LOW_VISIBILITY_LIMITS[-1])
    n_colors = VISIBILITY_CMAP.N
    return top, BoundaryNorm(np.arange(-0.5, top + 1), n_colors) if top < n_colors else Normalize(0, top)


def map_size_inches(low: np.ndarray, high: np.ndarray, max_width: float = 8.0) -> tuple[float, float]:
    """Width and height of the map in inches: true to scale, within a page or a part of it that is so wide."""
    across, along = high - low
    scale = min(max_width / across, 8.5 / along)
    return float(max(across * scale, 2.5)), float(max(along * scale, 2.5))
