"""PSNR by visibility group, a line for each method, a panel for each scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.bench.measure import group_names
from experiments.bench.plan import BenchPlan
from experiments.bench.result_tables import group_bounds
from experiments.bench.results import BenchResult
from experiments.bench.statistics import Summary, summarize
from vdgs.system.figure_style import ACCENT, DPI, INK, MUTED, draw_titles, style_axes

#: Colors and markers of the other methods, told apart without color too.
METHOD_COLORS = ("#1f6f8b", "#8ab17d", "#e0a030", "#7b5ea7", "#22262b", "#2a9d8f", "#b5838d", "#6c757d")
MARKERS = ("s", "^", "v", "D", "P", "X", "<", ">")
#: ... and where there are more methods than colors, those of each further round by their lines and hollow markers.
LINES = ("-", "--", ":")
#: In the title of a panel.
VISIBILITY_LABELS = {"truth": "true V", "model": "V by a coarse model"}
PANEL_WIDTH, PANEL_HEIGHT = 4.4, 3.6
#: Inches in the legend: a line with its marker and the space beside it, and a letter of 9 points on average.
HANDLE_WIDTH, LETTER_WIDTH = 0.65, 0.075


def plot_visibility_groups(file: Path, plan: BenchPlan, results: Sequence[BenchResult]) -> bool:
    """Write a PNG; False, and no file, where no group was measured."""
    scenes = [scene for scene in plan.scenes if any(r.groups for r in results if r.scene == scene.name)]
    if not scenes:
        return False
    width = max(0.4 + (PANEL_WIDTH + 0.75) * len(scenes), 7.5)
    columns = _columns([method.title for method in plan.methods], width - 0.75)
    legend = 0.2 * -(-len(plan.methods) // columns) + 0.25
    height = PANEL_HEIGHT + 2.2 + legend
    figure = Figure(figsize=(width, height), dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    panel = (width - 0.4) / len(scenes) - 0.75
    for index, scene in enumerate(scenes):
        left = 0.85 + index * (panel + 0.75)
        axes = figure.add_axes((left / width, (0.7 + legend) / height, panel / width, PANEL_HEIGHT / height))
        _panel(axes, plan, [each for each in results if each.scene == scene.name], scene.title, index == 0)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower left", bbox_to_anchor=(0.75 / width, 0.1 / height), ncols=columns,
                  frameon=False, fontsize=9)  # fmt: skip
    bars = "bars: standard deviation over seeds" if len(plan.seeds) > 1 else "one seed"
    draw_titles(figure, plan.table.title, "PSNR by how many training cameras see the place (raw, dB)",
           f"the same pixels for every method; {bars}")  # fmt: skip
    canvas.print_png(file)  # type: ignore[arg-type]
    return True


def _columns(labels: Sequence[str], width: float) -> int:
    """Up to three columns of a legend, as many as its labels leave room for in so many inches."""
    return min(3, max(1, int(width / (HANDLE_WIDTH + LETTER_WIDTH * max(map(len, labels))))))


def _panel(axes: Axes, plan: BenchPlan, results: Sequence[BenchResult], title: str, first: bool) -> None:
    groups = max((result.groups for result in results), key=len)
    positions = np.arange(len(groups), dtype=float)
    others = 0
    for index, method in enumerate(plan.methods):
        ours = method.name == plan.table.ours
        round_, style = (0, 0) if ours else divmod(others, len(METHOD_COLORS))
        color, marker = (ACCENT, "o") if ours else (METHOD_COLORS[style], MARKERS[style])
        others += not ours
        summaries = [_of(results, method.name, group) for group in range(len(groups))]
        measured = [(x, each) for x, each in zip(positions, summaries, strict=True) if each is not None]
        shift = 0.05 * (index - (len(plan.methods) - 1) / 2) if len(plan.seeds) > 1 else 0.0
        axes.errorbar(
            [x + shift for x, _ in measured], [each.mean for _, each in measured],
            yerr=[each.spread or 0.0 for _, each in measured] if len(plan.seeds) > 1 else None,
            color=color, marker=marker, markersize=5.5, markerfacecolor="white" if round_ else color,
            linestyle=LINES[round_ % len(LINES)], linewidth=2.2 if ours else 1.3, elinewidth=1.0, capsize=2.5,
            label=method.title, zorder=3 if ours else 2,
        )  # fmt: skip
    names = [
        f"{name}\nV {group_bounds(group)}"
        for name, group in zip(group_names(len(groups)), groups, strict=True)
    ]  # fmt: skip
    axes.set_xticks(positions, [name.replace(" seen ", "\nseen ") for name in names])
    source = next(result.visibility_source for result in results if result.groups)
    axes.set_title(f"{title}, {VISIBILITY_LABELS[source]}", fontsize=10.5, color=INK, loc="left")
    axes.grid(axis="y", color=MUTED, alpha=0.18, linewidth=0.7)
    if first:
        axes.set_ylabel("PSNR, dB")
    axes.margins(x=0.08, y=0.12)
    style_axes(axes)
    axes.tick_params(axis="x", labelsize=8)


def _of(results: Sequence[BenchResult], method: str, group: int) -> Summary | None:
    return summarize(each.figures.get(f"psnr@{group}") for each in results if each.method == method)
