"""The score matrix as a picture: which camera shows which block, and which were assigned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize, to_rgb

from vdgs.system import figure_style as style
from vdgs.system.figure_style import ACCENT, INK, MUTED, NOTE_SIZE, TEXT_SIZE, pluralize

#: From no score to the highest; nothing in it resembles the mark of an assigned camera.
SCORE_CMAP = LinearSegmentedColormap.from_list("score", ["#f1f3f5", "#a9c7d6", "#1f6f8b", "#14395b"])
#: A cell is so many pixels wide before it is drawn, but a row of them no more than that, if that leaves a few each; the
#: last ones are a gap.
CELL_PX, GAP_PX = 60, 3
MIN_CELL_PX, MAX_ROW_PX = 12, 3000
#: Width of the mark of an assigned camera, in inches.
MARK_INCHES = 0.12


def plot_scores(file: Path, scores: Float[np.ndarray, "c b"], assigned: Bool[np.ndarray, "c b"]) -> None:
    """Scores as a heat map: rows are cameras, by their best block and then by score. Writes a PNG.

    A red mark at the right of a cell says that the camera is assigned to the block.
    """
    cameras, blocks = scores.shape
    order, best = sort_cameras(scores)
    width = float(np.clip(0.55 * blocks, 4.5, 14.0))
    height = float(np.clip(0.2 * cameras, 2.0, 9.0))
    figure, place = style.new_figure(1.75 + width + 1.3, height + 1.9)
    axes = place(1.75, 0.65, width, height)
    norm = Normalize(min(0.0, float(scores.min(initial=0))), max(float(scores.max(initial=0)), 1e-6))
    if cameras:
        extent = (-0.5, blocks - 0.5, cameras - 0.5, -0.5)
        image = _cells(scores[order], assigned[order], norm, width / blocks)
        # Sharp where every camera has a row of pixels, else averaged so that none is dropped.
        smooth = "nearest" if cameras <= height * style.DPI else "antialiased"
        axes.imshow(image, aspect="auto", extent=extent, interpolation=smooth)
        bar = figure.colorbar(ScalarMappable(norm, SCORE_CMAP), cax=place(1.75 + width + 0.3, 0.65, 0.18, height))
        bar.set_label("score", color=INK, fontsize=TEXT_SIZE)
        bar.outline.set_visible(False)  # type: ignore[operator]
        bar.ax.tick_params(colors=MUTED, labelcolor=INK, labelsize=NOTE_SIZE)
    else:
        axes.text(0.5, 0.5, "no cameras", ha="center", va="center", transform=axes.transAxes, color=MUTED)
        axes.set_xlim(-0.5, blocks - 0.5)
    step = max(1, int(np.ceil(0.3 * blocks / width)))
    axes.set(xticks=np.arange(0, blocks, step), xlabel="block")
    style.style_axes(axes)
    _groups(axes, best, height)
    counts = assigned.sum(axis=1)
    serves = f"a camera serves {counts.mean():.2f} blocks on average, at most {counts.max()}" if cameras else ""
    note = "cameras by best block, then by score; red: assigned"
    style.draw_titles(figure, f"{pluralize(cameras, 'camera')}, {pluralize(blocks, 'block')}", serves, note)
    style.write_png(figure, file)


def sort_cameras(scores: Float[np.ndarray, "c b"]) -> tuple[Int[np.ndarray, " c"], Int[np.ndarray, " c"]]:
    """Cameras by best block, then from the highest score; and the best block of each in that order.

    Cameras without any score come last; their best block is that after the last one.
    """
    highest = scores.max(axis=1, initial=0.0)
    best = np.where(highest > 0, scores.argmax(axis=1), scores.shape[1])
    order = np.lexsort((-highest, best))
    return order, best[order]


def _cells(
    scores: Float[np.ndarray, "c b"], assigned: Bool[np.ndarray, "c b"], norm: Normalize, inches: float
) -> np.ndarray:
    """The image [c, cell * b, 3] of the matrix, whose cells are so many `inches` wide."""
    cell = max(MIN_CELL_PX, min(CELL_PX, MAX_ROW_PX // scores.shape[1]))
    gap = max(1, GAP_PX * cell // CELL_PX)
    mark = int(np.clip(cell * MARK_INCHES / inches, 2, cell // 4))
    cells = np.repeat(SCORE_CMAP(norm(scores))[:, :, None, :3], cell, axis=2)
    cells[:, :, cell - gap :] = 1.0
    cells[:, :, cell - gap - mark : cell - gap][assigned] = to_rgb(ACCENT)
    return cells.reshape(len(scores), -1, 3)


def _groups(axes: Axes, best: Int[np.ndarray, " c"], height: float) -> None:
    """Lines between cameras of different best blocks; names where there is room for them."""
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
    blocks, starts, sizes = np.unique(best, return_index=True, return_counts=True)
    most = round(axes.get_xlim()[1] + 0.5)
    last = -np.inf  # where the last name stands, in inches
    for block, start, size in zip(blocks, starts, sizes, strict=True):
        if start:
            axes.axhline(start - 0.5, color=INK, linewidth=0.8)
        middle = start + (size - 1) / 2
        inches = (middle + 0.5) / len(best) * height
        if inches - last < 0.16:
            continue
        last = inches
        name = f"best: block {block}" if block < most else "no score"
        axes.annotate(
            f"{name} ({size:,})", (0, middle), (-8, 0), xycoords=axes.get_yaxis_transform(), textcoords="offset points",
            ha="right", va="center", fontsize=NOTE_SIZE, color=INK,
        )  # fmt: skip
