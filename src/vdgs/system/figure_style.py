"""The look of all figures: ink, thin axes, titles, the colors of visibility."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from vdgs.system.atomic_files import write_atomic

INK, MUTED, ACCENT = "#22262b", "#6c757d", "#c1121f"
#: From hardly seen (alarming) to seen often (calm); dark enough everywhere to stand on white.
VISIBILITY_CMAP = LinearSegmentedColormap.from_list(
    "seen", ["#9d0208", "#dc2f02", "#f48c06", "#e9c46a", "#8ab17d", "#2a9d8f", "#1f6f8b", "#14395b"]
)
DPI = 120
#: Type in points: smaller type cannot be read where a figure of a page's width is shown at a screen's.
TEXT_SIZE, NOTE_SIZE = 11.0, 10.0
#: Smallest size of a title that is too long.
MIN_TITLE_SIZE = 4.0

#: Places axes in a figure by left, bottom, width, height in inches.
PlaceAxes = Callable[[float, float, float, float], Axes]


def new_figure(width: float, height: float) -> tuple[Figure, PlaceAxes]:
    """A figure of so many inches, and what places axes in it."""
    figure = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(figure)

    def place(left: float, bottom: float, across: float, up: float) -> Axes:
        width, height = figure.get_size_inches()
        return figure.add_axes((left / width, bottom / height, across / width, up / height))

    return figure, place


def write_png(figure: Figure, file: Path) -> None:
    write_atomic(file, figure.canvas.print_png)  # type: ignore[attr-defined]


def pluralize(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def draw_titles(figure: Figure, name: str, subtitle: str, note: str) -> None:
    """Three lines in the upper left corner, above 1.1 inches of free space; smaller where the figure is too narrow.

    They are drawn as they are, names with dollars too, which would else enclose a formula.
    """
    width, height = figure.get_size_inches()
    lines = ((name, 0.38, 15.0, INK), (subtitle, 0.69, TEXT_SIZE, MUTED), (note, 1.0, NOTE_SIZE, MUTED))
    for text, down, size, color in lines:
        weight = "bold" if color == INK else "normal"
        line = figure.text(
            0.85 / width, 1 - down / height, text, fontsize=size, fontweight=weight, color=color, parse_math=False
        )
        while line.get_window_extent().x1 > (width - 0.15) * figure.dpi and size > MIN_TITLE_SIZE:
            size *= 0.95  # hinted type does not shrink evenly
            line.set_fontsize(size)


def style_axes(axes: Axes) -> None:
    """Thin ink: no box, faint ticks."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.tick_params(colors=MUTED, labelcolor=INK, labelsize=NOTE_SIZE)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set(color=INK, fontsize=TEXT_SIZE)
