"""The figures of `vdgs inspect`: where the cameras are, and how often each place is seen."""

from __future__ import annotations

from operator import eq, ge
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from vdgs.captures.capture import Capture
from vdgs.report.capture_stats import CaptureReport
from vdgs.system import figure_style as style
from vdgs.system.figure_style import INK, NOTE_SIZE, TEXT_SIZE, VISIBILITY_CMAP, style_axes, write_png
from vdgs.system.units import format_length
from vdgs.visibility.visibility_counts import LOW_VISIBILITY_LIMITS
from vdgs.visibility.visibility_map import CameraMarks, VisibilityMapData, plot_visibility_map, visibility_color_norm


def draw_capture_map(
    capture: Capture, report: CaptureReport, points: np.ndarray, visibility: np.ndarray, file: Path
) -> None:
    """Cameras and points from above, points colored by V; beside it the histogram of V."""
    low, high = _frame(capture, points)
    marks = (
        CameraMarks("training camera", [view.camera for view in capture.train_views], INK, "white"),
        CameraMarks("test camera", [view.camera for view in capture.test_views], "white", INK),
    )
    x_label, y_label = capture.ground.axis_names
    data = VisibilityMapData(
        points=points, visibility=visibility, low=low, high=high, ground=float(np.median(capture.points[:, 2])),
        marks=marks, x_label=x_label, y_label=y_label, noun="a point", titles=_titles(capture, report),
    )  # fmt: skip
    plot_visibility_map(file, data)


def draw_visibility_histogram(report: CaptureReport, visibility: np.ndarray, file: Path) -> None:
    """How many points are seen at least so often, and the share that fewer than 3, 5, 10 cameras see."""
    figure = Figure(figsize=(10.5, 4.3), dpi=style.DPI, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)  # type: ignore[union-attr, call-arg]
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1])
    top, norm = visibility_color_norm(visibility)
    note, title = {"fontsize": NOTE_SIZE, "color": INK}, {"loc": "left", "fontsize": TEXT_SIZE, "color": INK}
    counts = np.arange(0, round(1.15 * top) + 2)
    at_least, exactly = (np.array([is_counted(visibility, n).mean() for n in counts]) for is_counted in (ge, eq))
    left.plot(counts, at_least, color=INK, linewidth=1.6, drawstyle="steps-mid")
    left.bar(counts, exactly, width=0.86, color=VISIBILITY_CMAP(norm(np.minimum(counts, top))))
    for limit in LOW_VISIBILITY_LIMITS:
        if limit <= visibility.max():
            share = float((visibility >= limit).mean())
            left.plot([limit], [share], "o", color=VISIBILITY_CMAP(norm(limit)), markersize=7, markeredgecolor="white")
            left.annotate(f"{share:.1%} by {limit} or more", (limit, share), (9, 7), textcoords="offset points", **note)
    left.set(xlim=(-0.6, counts[-1]), ylim=(0, 1.08), xlabel="training cameras that see a point, V")
    left.set_title("Share of the points seen by exactly V cameras (bars) and by at least V (line)", **title)
    shares = [report.fraction_below[limit] for limit in LOW_VISIBILITY_LIMITS]
    rows = np.arange(len(LOW_VISIBILITY_LIMITS))[::-1]
    colors = [VISIBILITY_CMAP(norm(min(limit - 1, top))) for limit in LOW_VISIBILITY_LIMITS]
    right.barh(rows, shares, color=colors, height=0.55)
    right.set_yticks(rows, [f"fewer than {limit}" for limit in LOW_VISIBILITY_LIMITS])
    for row, share in zip(rows, shares, strict=True):
        shift, side, color = (-0.015, "right", "white") if share > 0.8 else (0.015, "left", INK)
        right.text(share + shift, row, f"{share:.1%}", va="center", ha=side, fontsize=NOTE_SIZE, color=color)
    right.set(xlim=(0, min(1.0, max(0.3, 1.25 * max(shares)))), xlabel="share of the points")
    right.set_title("Poorly seen", **title)
    for axes, share_axis in ((left, left.yaxis), (right, right.xaxis)):
        style_axes(axes)
        share_axis.set_major_formatter(PercentFormatter(1, decimals=0))
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    right.tick_params(axis="y", length=0)
    write_png(figure, file)


def _titles(capture: Capture, report: CaptureReport) -> tuple[str, str, str]:
    name = f"{capture.root.resolve().name}: {report.train} training and {report.test} test photographs"
    lines = [
        f"{report.points:,} points",
        f"camera height {report.camera_height[1]:.3g} {report.unit}",
        f"{format_length(report.place.ground_sampling_distance, report.unit)} per pixel",
        f"a point is seen by {report.visibility_quantiles[50]:g} training cameras (median)",
    ]
    return name, "  ·  ".join(lines), "points colored by V; pale: V on level ground"


def _frame(capture: Capture, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corner points of the map: all cameras and 99 % of the points, with a margin."""
    centers = np.stack([view.camera.position[:2] for view in capture.views])
    low = np.minimum(np.quantile(points[:, :2], 0.005, axis=0), centers.min(axis=0))
    high = np.maximum(np.quantile(points[:, :2], 0.995, axis=0), centers.max(axis=0))
    margin = 0.04 * float((high - low).max())
    return low - margin, high + margin
