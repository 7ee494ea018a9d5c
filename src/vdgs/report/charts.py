"""Small diagrams, one idea each, so that they stand side by side on a desk and one below the other on a phone."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator

from vdgs.report.embedded_images import EmbeddedImage
from vdgs.system.figure_style import INK, MUTED

FIGURE_SIZE, DPI = (4.8, 3.0), 160
#: Curves of one diagram that a legend names at most, and points of a curve that are drawn.
MAX_LEGEND_ENTRIES, MAX_CURVE_POINTS = 10, 1500
COARSE_COLOR, MERGED_COLOR, LOSS_COLOR = "#8a939b", "#1f6f8b", "#c1121f"


@dataclass(frozen=True)
class Curve:
    """y over x; None in y is a gap. A curve without a name does not stand in the legend."""

    name: str
    color: str
    x: Sequence[float]
    y: Sequence[float | None]
    dashed: bool = False

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Thinned evenly to what can be seen, the last point kept."""
        x, y = np.asarray(self.x, float), np.array([np.nan if v is None else v for v in self.y], float)
        kept = np.unique(np.linspace(0, max(len(x) - 1, 0), min(len(x), MAX_CURVE_POINTS)).round().astype(int))
        return x[kept], y[kept]

    def has_data(self) -> bool:
        return any(value is not None for value in self.y)


def draw_curves(
    curves: Sequence[Curve],
    title: str,
    *,
    smoothing_window: int = 1,
    show_markers: bool = False,
    from_zero: bool = False,
    marked_iterations: Sequence[float] = (),
) -> EmbeddedImage | None:
    """Curves over the iteration, with dotted lines at `marked_iterations`.

    `smoothing_window` > 1 draws running medians over so many points, the points paler behind. None if there is no
    point to draw.
    """
    curves = [curve for curve in curves if curve.has_data()]
    if not curves:
        return None
    figure, axes = _panel(title)
    for curve in curves:
        x, y = curve.points()
        line = "--" if curve.dashed else "-"
        marker = "o" if show_markers else None
        if smoothing_window > 1 and len(x) > smoothing_window:
            axes.plot(x, y, color=curve.color, linewidth=0.8, alpha=0.3)
            y = running_median(y, smoothing_window)
        axes.plot(x, y, line, color=curve.color, linewidth=1.6, marker=marker, markersize=3.5, label=curve.name or "_")
    for mark in marked_iterations:
        axes.axvline(mark, color=MUTED, linewidth=1.0, linestyle=":")
    if from_zero:
        axes.set_ylim(0, 1.08 * axes.dataLim.y1 or 1.0)
    _scale_axes(axes)
    if 1 < sum(bool(curve.name) for curve in curves) <= MAX_LEGEND_ENTRIES:
        axes.legend(fontsize=8, frameon=False, ncols=1 + len(curves) // 6)
    return _to_image(figure)


def draw_psnr_bars(
    names: Sequence[str], coarse: Sequence[float | None], merged: Sequence[float | None]
) -> EmbeddedImage | None:
    """PSNR of both models, in pairs of bars from 0."""
    if not any(value is not None for value in [*coarse, *merged]):
        return None
    figure, axes = _panel("PSNR (dB)")
    at = np.arange(len(names), dtype=float)
    for shift, values, color, name in ((-0.2, coarse, COARSE_COLOR, "coarse"), (0.2, merged, MERGED_COLOR, "merged")):
        known = [0.0 if value is None else value for value in values]
        bars = axes.bar(at + shift, known, 0.38, color=color, label=name)
        axes.bar_label(bars, ["" if v is None else f"{v:.1f}" for v in values], fontsize=7, color=INK, padding=1)
    _name_bars(axes, names)
    axes.set_ylim(0, 1.3 * max(axes.get_ylim()[1], 1e-3))
    axes.legend(fontsize=8, frameon=False, ncols=2, loc="upper left")
    return _to_image(figure)


def draw_gain_bars(names: Sequence[str], gains: Sequence[float | None]) -> EmbeddedImage | None:
    """What the merged model gains over the coarse one: bars up (better) and down (worse) from 0."""
    if not any(value is not None for value in gains):
        return None
    figure, axes = _panel("merged − coarse, PSNR (dB)")
    known = [0.0 if value is None else value for value in gains]
    bars = axes.bar(range(len(names)), known, 0.6, color=[LOSS_COLOR if value < 0 else MERGED_COLOR for value in known])
    labels = ["" if value is None else f"{value:+.2f}".replace("-", "−") for value in gains]
    axes.bar_label(bars, labels, fontsize=8, color=INK, padding=2)
    axes.axhline(0, color=INK, linewidth=0.8)
    limit = 1.3 * max(abs(value) for value in known) or 1.0
    axes.set_ylim(min(-0.25 * limit, 1.3 * min(known)), max(0.25 * limit, 1.3 * max(known)))
    _name_bars(axes, names)
    return _to_image(figure)


def running_median(values: np.ndarray, window: int) -> np.ndarray:
    """The median over `window` values around each, fewer at the ends; gaps are passed over."""
    half = window // 2
    padded = np.pad(values, half, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    result = np.full(len(values), np.nan)
    known = ~np.isnan(around).all(axis=1)
    result[known] = np.nanmedian(around[known], axis=1)
    return result


def _panel(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=FIGURE_SIZE, dpi=DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.135, 0.17, 0.845, 0.735))  # fixed: finding margins takes longer than drawing
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=INK, labelsize=8.5)
    axes.grid(axis="y", color="#e6e9ec", linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def _name_bars(axes: Axes, names: Sequence[str]) -> None:
    axes.set_xticks(range(len(names)), names, fontsize=8 if len(names) < 7 else 6.5)
    axes.tick_params(axis="x", length=0)


def _scale_axes(axes: Axes) -> None:
    """Iterations below; large and small numbers without rows of zeros."""
    axes.set_xlabel("iteration", color=MUTED, fontsize=9)
    axes.margins(x=0.02)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    top = axes.get_ylim()[1]
    if top >= 2000:
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    elif top < 0.01:
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))


def _to_image(figure: Figure) -> EmbeddedImage:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    width, height = figure.canvas.get_width_height()
    return EmbeddedImage(buffer.getvalue(), width, height)
