"""The figures of `vdgs inspect`: where the cameras are, and how often each place is seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from vdgs.captures.capture import Capture
from vdgs.inspect import THIN, CaptureReport, count_views, length

INK, FAINT, ACCENT = "#22262b", "#6c757d", "#c1121f"
#: From hardly seen (alarming) to seen often (calm); dark enough everywhere to stand on white.
SEEN = LinearSegmentedColormap.from_list(
    "seen", ["#9d0208", "#dc2f02", "#f48c06", "#e9c46a", "#8ab17d", "#2a9d8f", "#1f6f8b", "#14395b"]
)
DPI = 120
FIELD_CELLS = 240


def draw_map(capture: Capture, report: CaptureReport, points: np.ndarray, visibility: np.ndarray, file: Path) -> None:
    """Cameras and points from above, points coloured by V; beside it the histogram of V."""
    low, high = _frame(capture, points)
    width, height = _map_size(low, high)
    figure = Figure(figsize=(width + 4.7, height + 1.75), dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    place = _placer(figure)
    axes = place(0.85, 0.65, width, height)
    top, norm = _steps(visibility)
    _ground(axes, capture, low, high, norm)
    order = np.argsort(-visibility, kind="stable")  # the poorly seen on top, so that none is hidden
    size = float(np.clip(6e4 / max(len(points), 1), 0.5, 7.0))
    axes.scatter(
        points[order, 0],
        points[order, 1],
        c=np.minimum(visibility[order], top),
        s=size,
        cmap=SEEN,
        norm=norm,
        linewidths=0,
    )
    _cameras(axes, capture)
    east, north = ("east", "north") if capture.ground.origin_geo else ("x", "y")
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel=f"{east} ({report.unit})", ylabel=f"{north} ({report.unit})")
    start = 0.85 + width + 0.75
    bar, histogram = place(start, 0.65, 0.2, height), place(start + 0.24, 0.65, 2.3, height)
    _histogram(bar, histogram, visibility, top, norm)
    _plain(axes)
    _titles(figure, capture, report)
    canvas.print_png(file)  # type: ignore[arg-type]


def draw_visibility(report: CaptureReport, visibility: np.ndarray, file: Path) -> None:
    """How many points are seen at least so often, and the share that fewer than 3, 5, 10 cameras see."""
    figure = Figure(figsize=(10.5, 4.3), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1])
    top, norm = _steps(visibility)
    counts = np.arange(0, round(1.15 * top) + 2)
    at_least = np.array([(visibility >= count).mean() for count in counts])
    left.plot(counts, at_least, color=INK, linewidth=1.6, drawstyle="steps-mid")
    exactly = np.array([(visibility == count).mean() for count in counts])
    left.bar(counts, exactly, width=0.86, color=SEEN(norm(np.minimum(counts, top))))
    for limit in THIN:
        if limit <= visibility.max():
            share = float((visibility >= limit).mean())
            left.plot([limit], [share], "o", color=SEEN(norm(limit)), markersize=7, markeredgecolor="white")
            left.annotate(
                f"{share:.1%} by {limit} or more",
                (limit, share),
                (9, 7),
                textcoords="offset points",
                fontsize=9,
                color=INK,
            )
    left.set(xlim=(-0.6, counts[-1]), ylim=(0, 1.08), xlabel="training cameras that see a point, V")
    left.set_title(
        "Share of the points seen by exactly V cameras (bars) and by at least V (line)",
        loc="left",
        fontsize=11,
        color=INK,
    )
    shares = [report.share_below[limit] for limit in THIN]
    rows = np.arange(len(THIN))[::-1]
    right.barh(rows, shares, color=[SEEN(norm(min(limit - 1, top))) for limit in THIN], height=0.55)
    right.set_yticks(rows, [f"fewer than {limit}" for limit in THIN])
    for row, share in zip(rows, shares, strict=True):
        inside = share > 0.8
        right.text(
            share + (-0.015 if inside else 0.015),
            row,
            f"{share:.1%}",
            va="center",
            ha="right" if inside else "left",
            fontsize=10,
            color="white" if inside else INK,
        )
    right.set(xlim=(0, min(1.0, max(0.3, 1.25 * max(shares)))), xlabel="share of the points")
    right.set_title("Poorly seen", loc="left", fontsize=11, color=INK)
    for axes in (left, right):
        _plain(axes)
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    left.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    right.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    right.tick_params(axis="y", length=0)
    canvas.print_png(file)  # type: ignore[arg-type]


def _steps(visibility: np.ndarray) -> tuple[int, Normalize]:
    """The greatest V that has a colour of its own, and integer colour steps from 0 to it.

    The 99 % quantile: a few points that very many cameras see must not flatten the rest.
    """
    top = max(int(np.quantile(visibility, 0.99)), THIN[-1])
    return top, BoundaryNorm(np.arange(-0.5, top + 1), SEEN.N) if top < SEEN.N else Normalize(0, top)


def _map_size(low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """Width and height of the map in inches: true to scale, within a page."""
    across, along = high - low
    scale = min(8.0 / across, 8.5 / along)
    return float(max(across * scale, 2.5)), float(max(along * scale, 2.5))


def _placer(figure: Figure) -> Callable[[float, float, float, float], Axes]:
    """Places axes by left, bottom, width, height in inches."""
    width, height = figure.get_size_inches()

    def place(left: float, bottom: float, across: float, up: float) -> Axes:
        return figure.add_axes((left / width, bottom / height, across / width, up / height))

    return place


def _titles(figure: Figure, capture: Capture, report: CaptureReport) -> None:
    width, height = figure.get_size_inches()
    name = f"{capture.root.resolve().name}: {report.train} training and {report.test} test photographs"
    figure.text(0.85 / width, 1 - 0.38 / height, name, fontsize=14, fontweight="bold", color=INK)
    facts = [
        f"{report.points:,} points",
        f"camera height {report.camera_height[1]:.3g} {report.unit}",
        f"{length(report.ground_sample_distance, report.unit)} per pixel",
        f"a point is seen by {report.visibility_quantiles[50]:g} training cameras (median)",
    ]
    figure.text(0.85 / width, 1 - 0.68 / height, "  ·  ".join(facts), fontsize=10, color=FAINT)
    note = "points coloured by V; pale: V on level ground"
    figure.text(0.85 / width, 1 - 1.0 / height, note, fontsize=9, color=FAINT)


def _frame(capture: Capture, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corner points of the map: all cameras and 99 % of the points, with a margin."""
    centres = np.stack([view.camera.position[:2] for view in capture.views])
    low = np.minimum(np.quantile(points[:, :2], 0.005, axis=0), centres.min(axis=0))
    high = np.maximum(np.quantile(points[:, :2], 0.995, axis=0), centres.max(axis=0))
    margin = 0.04 * float((high - low).max())
    return low - margin, high + margin


def _ground(axes: Axes, capture: Capture, low: np.ndarray, high: np.ndarray, norm: Normalize) -> None:
    """V on the level ground z = median height, pale, and its line V = 3: also where there are no points."""
    height = float(np.median(capture.points[:, 2]))
    x = np.linspace(low[0], high[0], FIELD_CELLS)
    y = np.linspace(low[1], high[1], FIELD_CELLS)
    grid = np.stack([*np.meshgrid(x, y), np.full((FIELD_CELLS, FIELD_CELLS), height)], axis=-1)
    field = count_views(grid.reshape(-1, 3), capture.train_views).reshape(FIELD_CELLS, FIELD_CELLS)
    axes.imshow(
        np.ma.masked_equal(field, 0),
        origin="lower",
        extent=(low[0], high[0], low[1], high[1]),
        cmap=SEEN,
        norm=norm,
        alpha=0.22,
        interpolation="nearest",
        zorder=0,
    )
    if field.min() < THIN[0] <= field.max():
        lines = axes.contour(x, y, field, levels=[THIN[0] - 0.5], colors=INK, linewidths=0.7, zorder=1)
        axes.clabel(lines, fmt=lambda _: f"V = {THIN[0]}", fontsize=8, inline=True)


def _cameras(axes: Axes, capture: Capture) -> None:
    for views, label, face, edge in (
        (capture.train_views, "training camera", INK, "white"),
        (capture.test_views, "test camera", "white", INK),
    ):
        centres = np.stack([view.camera.position for view in views])
        axes.scatter(
            centres[:, 0],
            centres[:, 1],
            marker="^",
            s=30,
            linewidths=0.8,
            label=label,
            zorder=3,
            facecolors=face,
            edgecolors=edge,
        )
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=2,
        fontsize=9,
        frameon=False,
        handletextpad=0.2,
        columnspacing=1.2,
        borderaxespad=0.1,
    )


def _histogram(bar: Axes, axes: Axes, visibility: np.ndarray, top: int, norm: Normalize) -> None:
    """The colour scale, and growing out of it the histogram of V; the last step holds all above it."""
    levels = np.arange(top + 1)
    bar.imshow(levels[:, None], origin="lower", extent=(0, 1, -0.5, top + 0.5), aspect="auto", cmap=SEEN, norm=norm)
    bar.set_xticks([])
    step = max(1, round(top / 10))
    ticks = [level for level in levels[::step] if level < top - step / 2] + [top]
    bar.set_yticks(ticks, [str(level) for level in ticks[:-1]] + [f"≥ {top}"])
    bar.set_ylabel("training cameras that see a point, V", labelpad=2)
    shares = np.bincount(np.minimum(visibility, top), minlength=top + 1) / len(visibility)
    axes.barh(levels, shares, height=0.86, color=SEEN(norm(levels)))
    median = min(float(np.median(visibility)), top)
    axes.plot([0, 1.12 * shares.max()], [median, median], color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.text(1.12 * shares.max(), median, " median", va="center", fontsize=9, color=INK)
    below = float((visibility < THIN[0]).mean())
    axes.text(
        shares[: THIN[0]].max() + 0.03 * shares.max(),
        1,
        f" {below:.1%} below {THIN[0]}",
        va="center",
        fontsize=10,
        fontweight="bold",
        color=ACCENT,
    )
    axes.set(ylim=(-0.5, top + 0.5), xlim=(0, 1.4 * shares.max()), yticks=[], xlabel="share of the points")
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    for part in (bar, axes):
        _plain(part)
        part.spines[:].set_visible(False)
    bar.tick_params(axis="y", length=0)


def _plain(axes: Axes) -> None:
    """Thin ink: no box, faint ticks."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(colors=FAINT, labelcolor=INK, labelsize=9)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
