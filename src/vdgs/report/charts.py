"""The charts that the report draws itself: training curves, growth cycles, quality by visibility."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from vdgs.figure_parts import DPI, FAINT, INK
from vdgs.partition.figure_words import block_colour
from vdgs.report.reading import number

Log = Sequence[Mapping[str, Any]]
#: key of the log, title
CURVES = (("psnr_smoothed", "PSNR of training views (dB)"), ("loss", "loss"), ("anchors", "anchors"))
CYCLES = (
    ("low_share", "share of anchors of low visibility"),
    ("mean_cache", "mean g over them"),
    ("grown_low", "new anchors with a parent in L"),
    ("grown_other", "other new anchors"),
)
BEFORE, AFTER = "#b9c2cc", "#1f6f8b"


def training_curves(coarse: Log, blocks: Mapping[int, Log]) -> Image.Image | None:
    """PSNR, loss and anchors over the iterations; None if nothing was logged."""
    return _curves({"coarse": (coarse, INK), **_named(blocks)}, CURVES)


def growth_cycles(blocks: Mapping[int, Log]) -> Image.Image | None:
    """What compensated growth saw and did, cycle by cycle; None if it never ran."""
    cycles = {
        name: ([row for row in log if "low_share" in row], colour) for name, (log, colour) in _named(blocks).items()
    }
    return _curves(cycles, CYCLES, marker="o")


def by_visibility(coarse: Sequence[Mapping[str, Any]], merged: Sequence[Mapping[str, Any]]) -> Image.Image | None:
    """PSNR of both models in each bin of V; None unless the bins are the same."""
    bounds = [[(row.get("lower"), row.get("upper")) for row in rows] for rows in (coarse, merged)]
    if not bounds[0] or bounds[0] != bounds[1]:
        return None
    figure = Figure(figsize=(7.2, 3.2), dpi=DPI, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    places = np.arange(len(coarse))
    every = []
    for offset, rows, colour, name in ((-0.2, coarse, BEFORE, "coarse"), (0.2, merged, AFTER, "merged")):
        heights = np.array([number(row.get("psnr")) or 0.0 for row in rows])
        every += heights.tolist()
        axes.bar(places + offset, heights, 0.38, color=colour, label=name)
        for place, height in zip(places, heights, strict=True):
            axes.text(place + offset, height + 0.15, f"{height:.1f}", ha="center", fontsize=8, color=INK)
    axes.set_xticks(places, [_bin_name(*bound) for bound in bounds[0]])
    low = max(0.0, min(every) - 3)
    axes.set(ylim=(low, max(every) + 2), xlabel="training cameras that see the place, V", ylabel="PSNR (dB)")
    axes.set_title(f"PSNR by visibility (axis starts at {low:.0f} dB)", loc="left", fontsize=10, color=INK)
    axes.legend(frameon=False, fontsize=9, loc="upper left", ncols=2)
    _plain(axes)
    return _image(canvas)


def _bin_name(lower: Any, upper: Any) -> str:
    first, last = number(lower), number(upper)
    return "nothing drawn" if first is None or last is None else f"{first:.3g} – {last:.3g}"


def _named(blocks: Mapping[int, Log]) -> dict[str, tuple[Log, Any]]:
    return {f"block {index}": (log, block_colour(index)) for index, log in blocks.items()}


def _curves(
    logs: Mapping[str, tuple[Log, Any]], wanted: Sequence[tuple[str, str]], marker: str = ""
) -> Image.Image | None:  # fmt: skip
    """One panel for each key, one line for each log."""
    logs = {name: pair for name, pair in logs.items() if pair[0]}
    if not logs:
        return None
    figure = Figure(figsize=(3.6 * len(wanted), 3.3), dpi=DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for axes, (key, title) in zip(np.atleast_1d(figure.subplots(1, len(wanted))), wanted, strict=True):
        for name, (log, colour) in logs.items():
            points = [(row["iteration"], value) for row in log if (value := number(row.get(key))) is not None]
            if points:
                axes.plot(
                    *zip(*points, strict=True), color=colour, linewidth=1.3, marker=marker, markersize=3, label=name
                )
        axes.set_title(title, loc="left", fontsize=10, color=INK)
        axes.set_xlabel("iteration of the stage", fontsize=9, color=FAINT)
        _plain(axes)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower left", ncols=min(9, len(names)), frameon=False, fontsize=9)
    return _image(canvas)


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(colors=FAINT, labelsize=8)


def _image(canvas: FigureCanvasAgg) -> Image.Image:
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
