"""The figure of what each block holds, beside what the cut by place alone would hold."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from vdgs.partition.blocks import Blocks, rows_by_owner, xy_positions
from vdgs.partition.plots.block_colors import block_color
from vdgs.system.figure_style import INK, MUTED, draw_titles, new_figure, pluralize, style_axes, write_png


def mix_color(color: str, scale: float, tone: float = 1.0) -> tuple[float, float, float]:
    """The color darkened by `scale`, then mixed with white; 1 and 1 leave it."""
    red, green, blue = (1 - tone * (1 - scale * part) for part in to_rgb(color))
    return red, green, blue


#: The rows of all blocks take at most so many inches, and from so few a row on they are numbered.
MAX_HEIGHT_INCHES, MIN_ROW_INCHES = 40.0, 0.05


def plot_block_stats(
    file: Path,
    positions: Float[np.ndarray, "n 3"],
    visibility: Int[np.ndarray, " n"],
    blocks: Blocks,
    assigned: Bool[np.ndarray, "c b"],
    unit: str,
    comparison: Blocks | None,
) -> None:
    """Per block: anchors, cameras, area of the core, V and its standard deviation, which eq. 5 is meant to lower.

    The blocks of `comparison` (λ_vis = 0) stand below in lighter tones. Writes a PNG; `unit` is that of places.
    """
    ours = compute_block_stats(positions, visibility, blocks)._replace(cameras=assigned.sum(axis=0))
    groups = [ours] if comparison is None else [ours, compute_block_stats(positions, visibility, comparison)]
    rows: list[Float[np.ndarray, " _"]] = [np.arange(len(blocks), dtype=np.float64)]
    if comparison is not None:
        rows.append(len(blocks) + 2.5 + np.arange(len(comparison)))
    count = float(rows[-1][-1] + 2)  # one row above the blocks names the cut
    # Inches; thousands of blocks make a picture that can still be opened, in which numbers are too small to be set.
    step = min(float(np.clip(14 / count, 0.13, 0.3)), MAX_HEIGHT_INCHES / count)
    set_numbers = step > MIN_ROW_INCHES
    figure, place = new_figure(14.5, 2.15 + step * count)
    panels = [place(1.15 + 2.65 * index, 0.65, 2.3, step * count) for index in range(5)]
    names = (
        "anchors of the core", "cameras assigned", f"area of the core ({unit}²)",
        "V: mean, 5–95 % of the anchors", "standard deviation of V",
    )  # fmt: skip
    for index, (axes, name) in enumerate(zip(panels, names, strict=True)):
        ends = [
            _panel(axes, index, group, group_rows, tone, step if set_numbers else None)
            for group, group_rows, tone in zip(groups, rows, (1.0, 0.45), strict=False)
        ]
        # From 0, with room for the number right of the longest bar.
        axes.set_xlim(0, 1.38 * max(ends) or 1.0)
        axes.set_ylim(count - 1.3, -1.3)
        axes.set_title(name, loc="left", fontsize=10, color=INK)
        _rows(axes, rows, index == 0 and set_numbers, step)
        axes.xaxis.set_major_locator(MaxNLocator(3, integer=index < 2, min_n_ticks=1))
    note = "mean over the blocks of the standard deviation of V within each: " + _both(groups)
    captions = ("",) if comparison is None else ("this cut", "cut by place alone, λ_vis = 0 (numbers of its own)")
    size = _font(step) if set_numbers else 8.0
    for group_rows, caption in zip(rows, captions, strict=True):
        y = group_rows[0] - 0.95
        panels[0].text(0, y, caption, va="center", fontsize=size, fontweight="bold", color=INK)
    draw_titles(figure, pluralize(len(blocks), "block"), note, "colors and numbers are those of the map of blocks")
    write_png(figure, file)


class BlockStats(NamedTuple):
    """What is drawn of each block; NaN where it owns no anchor."""

    anchors: Int[np.ndarray, " b"]
    cameras: Int[np.ndarray, " b"] | None
    area: Float[np.ndarray, " b"]
    mean: Float[np.ndarray, " b"]
    low: Float[np.ndarray, " b"]
    high: Float[np.ndarray, " b"]
    spread: Float[np.ndarray, " b"]


def compute_block_stats(
    positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"], blocks: Blocks
) -> BlockStats:
    """What a cut gives each block, without cameras; `visibility` are the V of the anchors."""
    owner = blocks.owner(xy_positions(positions))
    seen = [visibility[rows] for rows in rows_by_owner(owner, len(blocks))]
    nothing = (np.nan,) * 4
    of_views = np.array(
        [(v.mean(), *np.quantile(v, (0.05, 0.95)), v.std()) if len(v) else nothing for v in seen], np.float64
    )
    area = np.array([block.core.area for block in blocks.items])
    return BlockStats(np.array([len(v) for v in seen]), None, area, *of_views.T)


def _panel(
    axes: Axes, index: int, stats: BlockStats, rows: Float[np.ndarray, " b"], tone: float, step: float | None
) -> float:
    """One column of the figure for one cut; returns where its longest bar ends. `step` is the height of a row in
    inches; without it no numbers stand beside the bars."""
    colors = [mix_color(block_color(block), 1.0, tone) for block in range(len(rows))]
    if index == 3:
        known = np.isfinite(stats.mean)
        axes.hlines(rows[known], stats.low[known], stats.high[known], np.array(colors)[known], linewidth=3)
        axes.scatter(stats.mean[known], rows[known], s=26, color=INK, zorder=3, linewidths=0)
        right = stats.high
        labels = [f"{mean:.1f}" for mean in stats.mean]
    else:
        values = (stats.anchors, stats.cameras, stats.area, None, stats.spread)[index]
        if values is None:
            text, transform = "no cameras are assigned\nto this cut", axes.get_yaxis_transform()
            axes.text(0.02, float(rows.mean()), text, transform=transform, va="center", fontsize=8, color=MUTED)
            return 0.0
        right = np.nan_to_num(values.astype(np.float64))
        _bars(axes, rows, right, colors)
        labels = [_number(float(value), index) for value in values]
    longest = float(np.nanmax(right, initial=0.0))
    if step is None:
        return longest
    for row, end, label in zip(rows, right, labels, strict=True):
        missing = label == "nan"
        axes.annotate(
            "no anchors" if missing else label, (0 if missing else end, row), (6, 0), textcoords="offset points",
            va="center", fontsize=_font(step), color=MUTED if missing else INK,
        )  # fmt: skip
    return longest


def _bars(
    axes: Axes, rows: Float[np.ndarray, " b"], ends: Float[np.ndarray, " b"], colors: list[tuple[float, float, float]]
) -> None:
    """Bars from 0 as one collection: thousands of patches take matplotlib minutes."""
    low, high = rows - 0.36, rows + 0.36
    corners = [(np.zeros_like(ends), low), (ends, low), (ends, high), (np.zeros_like(ends), high)]
    polygons = np.stack([np.stack(each, -1) for each in corners], 1)
    axes.add_collection(PolyCollection(list(polygons), facecolors=colors))


def _rows(axes: Axes, rows: list[Float[np.ndarray, " _"]], named: bool, step: float) -> None:
    """Block numbers at the left, and the ink of one panel."""
    style_axes(axes)
    axes.patch.set_visible(False)  # captions reach into the next panel
    numbers = [f"block {index}" for group in rows for index in range(len(group))]
    axes.set_yticks(*((np.concatenate(rows), numbers) if named else ([],)))
    axes.tick_params(axis="y", length=0, labelsize=_font(step))
    axes.spines["left"].set_visible(False)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    if len(rows) > 1:
        axes.axhline(rows[1][0] - 1.7, color=MUTED, linewidth=0.6)


def _font(step: float) -> float:
    """A size of type that fits into rows of `step` inches."""
    return min(9.0, 72 * step * 0.75)


def _number(value: float, index: int) -> str:
    if np.isnan(value):
        return "nan"
    if index == 4:
        return f"{value:.2f}"
    return f"{value:,.0f}" if index < 2 or value >= 1000 else f"{value:.3g}"


def _both(groups: list[BlockStats]) -> str:
    ours = _mean_spread(groups[0].spread)
    return ours if len(groups) == 1 else f"{ours}; cut by place alone (λ_vis = 0): {_mean_spread(groups[1].spread)}"


def _mean_spread(spread: Float[np.ndarray, " b"]) -> str:
    known = spread[np.isfinite(spread)]
    return f"{known.mean():.2f}" if len(known) else "none"


def std_note(spread: Float[np.ndarray, " b"]) -> str:
    """One line about the `spread` of all blocks, the standard deviation of V in each."""
    return f"standard deviation of V in a block: {_mean_spread(spread)} (mean over the blocks)"
