"""The figures of `vdgs partition`: blocks on the map, facts of each block, and which camera belongs to which."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from vdgs.geometry.camera import Camera
from vdgs.geometry.similarity import sample_points
from vdgs.partition.blocks import Blocks
from vdgs.partition.plots.block_colors import block_color
from vdgs.partition.plots.block_stats import compute_block_stats, mix_color, plot_block_stats, std_note
from vdgs.partition.plots.score_heatmap import plot_scores
from vdgs.system.figure_style import (
    INK,
    MUTED,
    NOTE_SIZE,
    TEXT_SIZE,
    draw_titles,
    new_figure,
    pluralize,
    style_axes,
    write_png,
)
from vdgs.visibility import visibility_map

__all__ = ["plot_anchor_visibility", "plot_block_stats", "plot_blocks", "plot_scores"]

#: More anchors than these are thinned: on a map they only cover each other.
MAX_DRAWN_ANCHORS = 60_000
#: What the cut that is compared with is called.
SPATIAL_ONLY_LABEL = "λ_vis = 0: cut by place alone (numbers of its own)"
#: The narrower side of a map is at least this share of the wider one: corridors stay legible.
MIN_ASPECT = 0.3
#: Outlines widen a map of blocks by at most this share of its longer side, to each side.
MAX_OUTLINE_MARGIN = 0.75
#: Width of a map of blocks: two stand beside each other on a page.
MAP_WIDTH_INCHES = 6.2


def plot_anchor_visibility(
    file: Path,
    positions: Float[np.ndarray, "n 3"],
    visibility: Int[np.ndarray, " n"],
    cameras: Sequence[Camera],
    axes: tuple[str, str],
) -> None:
    """Anchors from above colored by V_i, cameras, and the histogram of V. Writes a PNG; `axes` are the names of x
    and y with their unit (`GroundFrame.axis_names`)."""
    low, high = _map_corners(np.concatenate([_inner_quantiles(positions[:, :2]), _camera_xy(cameras)]))
    marks = visibility_map.CameraMarks("training camera", cameras, INK, "white", _mark_size(len(cameras)))
    facts = f"an anchor is seen by {np.median(visibility):g} training cameras (median)"
    heading = (f"{pluralize(len(visibility), 'anchor')} and {pluralize(len(cameras), 'training camera')}", facts)
    data = visibility_map.VisibilityMapData(
        points=positions, visibility=visibility, low=low, high=high, ground=float(np.median(positions[:, 2])),
        marks=(marks,), x_label=axes[0], y_label=axes[1], noun="an anchor",
        titles=(*heading, "anchors colored by V; pale: V on level ground"),
    )  # fmt: skip
    visibility_map.plot_visibility_map(file, data)


def plot_blocks(
    file: Path,
    positions: Float[np.ndarray, "n 3"],
    visibility: Int[np.ndarray, " n"],
    cameras: Sequence[Camera],
    assigned: Bool[np.ndarray, "c b"],
    cuts: Sequence[tuple[str, Blocks]],
    names: tuple[str, str],
) -> None:
    """Anchors from above colored by block, with outlines and cameras, for each of the `cuts` with its name.

    The first cut is the scene's own, to which cameras are assigned; another is there to compare with. The map shows
    99 % of the anchors in x and in y and all outlines, if these do not lead far away. Writes a PNG; `names` are those
    of x and y with their unit (`GroundFrame.axis_names`).
    """
    low, high, whole = _frame_of_blocks(_inner_quantiles(positions[:, :2]), [cut for _, cut in cuts])
    width, height = visibility_map.map_size_inches(low, high, MAP_WIDTH_INCHES)
    (_, blocks), count = cuts[0], len(cuts)
    columns, rows = (count, 1) if width < 1.7 * height else (1, count)
    figure, place = new_figure(max(0.85 + columns * (width + 0.75), 7.5), 1.15 + rows * (height + 1.1))
    shown = sample_points(positions[:, :2].astype(np.float64), MAX_DRAWN_ANCHORS)
    for index, (name, cut) in enumerate(cuts):
        row, column = index // columns, index % columns
        left, bottom = 0.85 + column * (width + 0.75), 0.55 + (rows - 1 - row) * (height + 1.1)
        axes = place(left, bottom, width, height)
        _plot_partition(axes, cut, shown, low, high)
        used = np.asarray(assigned.any(axis=1)) if cut is blocks else np.ones(len(cameras), bool)
        _cameras(axes, _camera_xy(cameras), used)
        spread = compute_block_stats(positions, visibility, cut).spread
        axes.set_title(f"{name}\n{std_note(spread)}", loc="left", fontsize=TEXT_SIZE, color=INK)
        axes.set(xlabel=names[0], ylabel=names[1])
    _heading(figure, blocks, (len(positions), len(shown)), _camera_xy(cameras), (low, high), whole)
    _legend(figure, bool(assigned.any(axis=1).all()))
    write_png(figure, file)


def _camera_xy(cameras: Sequence[Camera]) -> Float[np.ndarray, "c 2"]:
    return np.array([camera.position[:2] for camera in cameras], np.float64).reshape(-1, 2)


def _mark_size(cameras: int) -> float:
    """Size of a camera mark in points²: thousands must not hide the map."""
    return float(np.clip(9000 / max(cameras, 1), 8, 30))


def _inner_quantiles(positions: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2 2"]:
    """The 0.5 % and 99.5 % quantiles in x and in y."""
    return np.quantile(np.asarray(positions, np.float64), (0.005, 0.995), axis=0)


def _map_corners(corners: Float[np.ndarray, "n 2"], margin: float = 0.08) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner of a map that holds `corners`, with a margin; neither a point nor a strip."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    longest = float((high - low).max()) or 1.0
    grow = np.maximum(margin * longest, (MIN_ASPECT * longest - (high - low)) / 2)
    return low - grow, high + grow


def _frame_of_blocks(
    inner: Float[np.ndarray, "2 2"], cuts: Sequence[Blocks]
) -> tuple[np.ndarray, np.ndarray, bool]:  # fmt: skip
    """The corners of a map of blocks, and whether it holds all outlines. It holds them unless they reach farther beyond
    the anchors than `MAX_OUTLINE_MARGIN` of the longer side: one stray block must not make a stamp of the map."""
    bounds = np.array([block.expanded.bounds for cut in cuts for block in cut.items]).reshape(-1, 2, 2)
    outlines = np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])
    reach = MAX_OUTLINE_MARGIN * float(np.ptp(inner, axis=0).max())
    held = np.clip(outlines, inner[0] - reach, inner[1] + reach)
    low, high = _map_corners(np.concatenate([inner, held]), margin=0.03)
    return low, high, bool(((outlines >= low) & (outlines <= high)).all())


def _plot_partition(
    axes: Axes, blocks: Blocks, shown: Float[np.ndarray, "n 2"], low: np.ndarray, high: np.ndarray
) -> None:
    """Anchors in the colors of their blocks, cores and widened boundaries, and the numbers."""
    owner = blocks.owner(shown)
    palette = np.array([to_rgb(block_color(index)) for index in range(len(blocks))])
    size = float(np.clip(3e4 / len(shown), 0.6, 7.0))
    axes.scatter(shown[:, 0], shown[:, 1], c=palette[owner], s=size, linewidths=0, alpha=0.75)
    window = shapely.box(*low, *high)
    for index, block in enumerate(blocks.items):
        dark = mix_color(block_color(index), 0.65)
        axes.add_patch(_outline_patch(block.expanded, dark, 1.0, (0, (4, 3))))
        axes.add_patch(_outline_patch(block.core, INK, 1.1, "solid"))
        position = _label_position(block.core, window)
        if position is not None:
            axes.text(
                *position, str(index), ha="center", va="center", fontsize=12 if len(blocks) <= 40 else 8,
                fontweight="bold", color=dark, zorder=5,
                bbox={"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": dark, "linewidth": 0.8},
            )  # fmt: skip
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    style_axes(axes)


def _outline_patch(shape: shapely.Polygon, color: object, width: float, style: object) -> PathPatch:
    """The outline of a polygon, holes included."""
    rings = [Outline(np.asarray(ring.coords), closed=True) for ring in (shape.exterior, *shape.interiors)]
    whole = Outline.make_compound_path(*rings)
    return PathPatch(whole, facecolor="none", edgecolor=color, linewidth=width, linestyle=style, zorder=2)


def _label_position(core: shapely.Polygon, window: shapely.Polygon) -> tuple[float, float] | None:
    """Where in the visible part of a core there is most room for its number; None where nothing of it is visible."""
    largest = max(shapely.get_parts(core.intersection(window)), key=lambda part: part.area, default=None)
    if largest is None or largest.area == 0:
        return None
    x, y = shapely.maximum_inscribed_circle(largest).coords[0]
    return x, y


def _cameras(axes: Axes, positions: Float[np.ndarray, "c 2"], used: Bool[np.ndarray, " c"]) -> None:
    """Cameras as small triangles; white those that are not `used`."""
    size = 0.7 * _mark_size(len(positions))
    for chosen, face, edge in ((used, INK, "white"), (~used, "white", INK)):
        visibility_map.draw_triangles(axes, positions[chosen], size, face, edge, zorder=4)


def _heading(
    figure: Figure, blocks: Blocks, anchors: tuple[int, int], cameras: Float[np.ndarray, "c 2"],
    frame: tuple[np.ndarray, np.ndarray], whole: bool,
) -> None:  # fmt: skip
    """What is shown, and what is not: `anchors` are (all, drawn), cameras and, if not `whole`, outlines may lie beyond
    the frame."""
    total, drawn = anchors
    outside = int((~((cameras >= frame[0]) & (cameras <= frame[1])).all(axis=1)).sum())
    facts = pluralize(total, "anchor") + (f" ({drawn:,} drawn)" if drawn < total else "")
    seen = pluralize(len(cameras), "training camera") + (f" ({outside:,} beyond the map)" if outside else "")
    beyond = "" if whole else "  ·  outlines run on beyond the map"
    draw_titles(figure, pluralize(len(blocks), "block"), f"{facts}  ·  {seen}{beyond}", "")


def _legend(figure: Figure, all_used: bool) -> None:
    triangle = {"marker": "^", "linestyle": "none", "markersize": 5.5, "markeredgewidth": 0.7}
    lines = [
        Line2D([], [], color=INK, linewidth=1.1, label="core"),
        Line2D([], [], color=MUTED, linewidth=1.0, linestyle=(0, (4, 3)), label="widened block"),
        Line2D([], [], **triangle, color=INK, markeredgecolor="white", label="camera"),  # type: ignore[arg-type]
        Line2D([], [], **triangle, color="white", markeredgecolor=INK, label="camera of no block"),  # type: ignore[arg-type]
    ]
    width, height = figure.get_size_inches()
    figure.legend(
        handles=lines[:3] if all_used else lines, loc="upper left", bbox_to_anchor=(0.85 / width, 1 - 0.84 / height),
        ncols=4, fontsize=NOTE_SIZE, frameon=False, handletextpad=0.5, columnspacing=1.2, borderaxespad=0, borderpad=0,
    )  # fmt: skip
