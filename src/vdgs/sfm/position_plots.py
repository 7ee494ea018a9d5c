"""Pictures from above: where the photographs were taken, and how far each lies from its recorded position."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vdgs.sfm.georegistration import Georegistration
from vdgs.sfm.gps_priors import GpsPriors
from vdgs.system import figure_style as style
from vdgs.system.atomic_files import write_bytes
from vdgs.system.figure_style import ACCENT, INK, MUTED, TEXT_SIZE, style_axes

#: The longest arrow of a residual is drawn this share of the picture long at most.
MAX_ARROW_SHARE = 0.12


def plot_positions(positions: GpsPriors, order: Sequence[int], title: str, file: Path) -> None:
    """Positions from above in the order of their time, before any work; nothing where there are none."""
    if len(positions):
        figure, axes = _axes(title)
        enu = positions.enu[list(order)]
        axes.plot(enu[:, 0], enu[:, 1], color=MUTED, linewidth=0.8)
        axes.plot(enu[:, 0], enu[:, 1], "o", color=INK, markersize=4)
        axes.plot(enu[:1, 0], enu[:1, 1], "o", color=ACCENT, markersize=7, label="the first")
        axes.legend(frameon=False, loc="best")
        _write(figure, file)


def plot_residuals(
    points: np.ndarray, positions: GpsPriors, placed: Georegistration | None, gcps: Mapping[str, np.ndarray], file: Path
) -> None:
    """Points from above; of every photograph the recorded position, and an arrow to where it was placed; surveyed
    points by their names."""
    factor, arrows = 1, placed is not None and len(placed.position_rows) > 0
    if placed is not None and arrows:
        span = float(np.ptp(positions.enu[placed.position_rows, :2], axis=0).max())
        longest = float(np.linalg.norm(placed.residuals[:, :2], axis=1).max())
        factor = next((n for n in (100, 50, 20, 10, 5, 2) if n * longest <= MAX_ARROW_SHARE * span), 1)
    title = (
        f"From recorded to placed positions{f', drawn {factor} times as long' if factor > 1 else ''}"
        if arrows
        else "The points from above"
    )
    figure, axes = _axes(title, metric=placed is not None)
    few = points[:: max(1, len(points) // 20_000)]
    low, high = np.quantile(few[:, :2], [0.01, 0.99], axis=0)
    axes.plot(few[:, 0], few[:, 1], "o", markersize=1.2, markeredgewidth=0, color=MUTED, alpha=0.6, zorder=1)
    if placed is not None and arrows:
        at, move = positions.enu[placed.position_rows, :2], factor * placed.residuals[:, :2]
        low, high = np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))
        axes.plot(at[:, 0], at[:, 1], "o", color=INK, markersize=3, zorder=2)
        axes.quiver(
            at[:, 0], at[:, 1], move[:, 0], move[:, 1], angles="xy", scale_units="xy", scale=1, width=0.003,
            color=[INK if trusted else ACCENT for trusted in placed.inliers], zorder=3,
        )  # fmt: skip
    if placed is not None and not placed.inliers.all():
        axes.plot([], [], color=ACCENT, label="not trusted")
        axes.legend(frameon=False, loc="best")
    for name, place in gcps.items():
        low, high = np.minimum(low, place[:2]), np.maximum(high, place[:2])
        axes.plot(*place[:2], "^", color=ACCENT, markersize=6, zorder=4)
        axes.annotate(
            name, place[:2], textcoords="offset points", xytext=(5, 3), fontsize=TEXT_SIZE - 2, color=INK,
            parse_math=False,
        )  # fmt: skip
    margin = 0.05 * float((high - low).max()) + 1e-9
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    _write(figure, file)


def _axes(title: str, metric: bool = True):  # type: ignore[no-untyped-def]
    figure = Figure(figsize=(8.5, 7.5), dpi=style.DPI, layout="constrained")
    axes = figure.subplots()
    axes.set_aspect("equal", adjustable="box")
    axes.set_title(title, loc="left", fontsize=TEXT_SIZE, color=INK, parse_math=False)
    axes.set(xlabel="east [m]" if metric else "x", ylabel="north [m]" if metric else "y")
    style_axes(axes)
    return figure, axes


def _write(figure: Figure, file: Path) -> None:
    drawn = io.BytesIO()
    FigureCanvasAgg(figure).print_png(drawn)
    write_bytes(file, drawn.getvalue())
