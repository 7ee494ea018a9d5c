"""Which cameras train which block, decided from the score matrix (section IV-B).

The paper assigns a camera where its score is above a threshold. Alone, that leaves cameras without any block and
blocks without any camera; so (choice) every camera also joins its best block, and every block is topped up with its
best views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Int64
from rich import box
from rich.table import Table

from vdgs.config.method import AssignmentConfig
from vdgs.errors import RunError
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.block_records import BlockCamerasRecord, BlockRecord
from vdgs.partition.blocks import Blocks, rows_by_owner, xy_positions

#: What the numbers in `Assignment.reasons` mean.
NOT_ASSIGNED, ABOVE_THRESHOLD, BEST_BLOCK, TOPPED_UP = range(4)
REASONS = ("not assigned", "above the threshold", "the view's best block", "topped up")
#: field of a row, heading, format
TABLE_COLUMNS = (
    ("block", "block", "{}"),
    ("cameras", "cameras", "{:,}"),
    ("extra_cameras", "added", "{:,}"),
    ("anchors_core", "anchors", "{:,}"),
    ("anchors_expanded", "widened", "{:,}"),
    ("mean_v", "mean V", "{:.1f}"),
    ("area", "area", "{:,.0f}"),
)


@dataclass(frozen=True, eq=False)
class Assignment:
    """The cameras of every block: rows are cameras, columns blocks."""

    cameras: Bool[np.ndarray, "c b"]
    #: The first reason that applied, as an index of `REASONS`.
    reasons: Int8[np.ndarray, "c b"]
    #: One sentence for each block that has no camera, or that none of the cameras sees, and one on idle cameras.
    warnings: list[str]


def assign_cameras(scores: ScoreMatrix, config: AssignmentConfig) -> Assignment:
    """Decide from the scores; the threshold is that of the mode in which they were made.

    1. A camera whose score is above the threshold joins, if its frustum holds any anchor of the block's core: without
       one it has nothing to teach. Mode `paper` asks the score alone, as printed.
    2. Every camera joins its best block among those of which it holds an anchor. One that holds none joins the block
       with the best score, or where all are 0 the one beneath it: every camera serves at least one block. Not so
       without `config.always_best`.
    3. Every block with fewer than `config.min_cameras` is topped up with the best of the cameras that hold an anchor of
       it, until it has so many or all of them.

    "Best" is by score, among equals by anchors held, then by index.
    """
    seen = scores.visible_anchors > 0
    threshold = config.threshold_leave_one_out if scores.mode == "leave-one-out" else config.threshold
    reasons = np.zeros(scores.scores.shape, np.int8)
    reasons[(scores.scores > threshold) & (seen | (scores.mode == "paper"))] = ABOVE_THRESHOLD
    if config.always_best:
        rows, best = np.arange(len(reasons)), _best_blocks(scores)
        reasons[rows, best] = np.where(reasons[rows, best] == NOT_ASSIGNED, BEST_BLOCK, reasons[rows, best])
    for block in range(len(scores.anchors)):
        missing = max(config.min_cameras - np.count_nonzero(reasons[:, block]), 0)
        order = np.lexsort((-scores.visible_anchors[:, block], -scores.scores[:, block]))
        candidates = order[seen[order, block] & (reasons[order, block] == NOT_ASSIGNED)]
        reasons[candidates[:missing], block] = TOPPED_UP
    return Assignment(reasons != NOT_ASSIGNED, reasons, _warnings(scores, reasons, threshold, config.always_best))


def _best_blocks(scores: ScoreMatrix) -> np.ndarray:
    """The best block of every camera, [c]."""
    if not len(scores.scores):
        return np.zeros(0, np.int64)
    seen = scores.visible_anchors > 0
    best = np.lexsort((-scores.visible_anchors, -scores.scores, ~seen), axis=-1)[:, 0]
    blank = ~seen.any(axis=1) & (scores.scores.max(axis=1) == scores.scores.min(axis=1))
    return np.where(blank, scores.nadir_block, best)


def _warnings(scores: ScoreMatrix, reasons: np.ndarray, threshold: float, always_best: bool) -> list[str]:
    warnings = []
    for block, anchors in enumerate(scores.anchors):
        watching = int(np.count_nonzero(scores.visible_anchors[:, block]))
        if anchors == 0:
            warnings.append(
                f"Block {block} holds no anchors. Cut the scene into fewer blocks: --blocks (num_blocks in Python)."
            )
        elif watching == 0:
            warnings.append(
                f"Block {block}: no training camera sees any of its {anchors:,} anchors. It cannot be trained; the "
                "coarse anchors stay. Fewer blocks (--blocks; num_blocks in Python) would join it to one that is seen."
            )
        elif not reasons[:, block].any():
            warnings.append(
                f"Block {block}: {watching} training camera(s) see some of its {anchors:,} anchors, but none scores "
                f"above {threshold:g} (best: {scores.scores[:, block].max():.3g}). Lower --assignment.threshold or "
                "raise --assignment.min-cameras."
            )
    idle = ~((reasons != NOT_ASSIGNED) & (scores.visible_anchors > 0)).any(axis=1)
    if idle.any() and not always_best:
        warnings.append(
            f"{np.count_nonzero(idle)} of {len(idle)} training photographs train no block's core: none with an anchor "
            f"in view scores above {threshold:g}. --assignment.always-best lets each join its best block."
        )
    return warnings


@dataclass(frozen=True)
class AssignmentReason:
    """How well a view shows a block, and why it was assigned to it or not."""

    block: int
    score: float
    visible_anchors: int
    """Anchors of the block that the view holds."""
    reason: str
    """A phrase."""


def explain_assignment(
    names: Sequence[str], scores: ScoreMatrix, assignment: Assignment, view: str
) -> list[AssignmentReason]:
    """Why a view was chosen for each block, or not: those that it serves first, then by falling score.

    Raises RunError for a view that is not there.
    """
    if view not in names:
        raise RunError(f"There is no training view {view!r}. Views are named as in the capture, such as {names[0]!r}.")
    c = names.index(view)
    rows = [
        AssignmentReason(
            b, float(scores.scores[c, b]), int(scores.visible_anchors[c, b]), REASONS[assignment.reasons[c, b]]
        )
        for b in range(len(scores.anchors))
    ]
    return sorted(rows, key=lambda row: (row.reason == REASONS[0], -row.score))


def block_rows(
    blocks: Blocks, positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"]
) -> tuple[BlockRecord, ...]:
    """Anchors, area and visibility of each block of a cut."""
    return _block_rows(blocks, blocks.owner(xy_positions(positions)), visibility)


def _block_rows(
    blocks: Blocks, owner: Int64[np.ndarray, " n"], visibility: Int[np.ndarray, " n"]
) -> tuple[BlockRecord, ...]:
    seen = [visibility[rows] for rows in rows_by_owner(owner, len(blocks))]
    return tuple(
        BlockRecord(
            index, len(views), float(block.core.area),
            mean_v=float(views.mean()) if len(views) else None, std_v=float(views.std()) if len(views) else None,
        )
        for index, (block, views) in enumerate(zip(blocks.items, seen, strict=True))
    )  # fmt: skip


def assignment_rows(
    blocks: Blocks, positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"], assignment: Assignment
) -> list[BlockCamerasRecord]:
    """What was decided for each block."""
    points = xy_positions(positions)
    owner = blocks.owner(points)
    return [
        BlockCamerasRecord(
            **asdict(row), cameras=int(np.count_nonzero(reasons)),
            above_threshold=int(np.count_nonzero(reasons == ABOVE_THRESHOLD)),
            best_block=int(np.count_nonzero(reasons == BEST_BLOCK)),
            topped_up=int(np.count_nonzero(reasons == TOPPED_UP)),
            anchors_expanded=int(np.count_nonzero(blocks.in_expanded(row.block, points, owner))),
        )
        for row, reasons in zip(_block_rows(blocks, owner, visibility), assignment.reasons.T, strict=True)
    ]  # fmt: skip


def make_assignment_table(rows: Sequence[BlockCamerasRecord]) -> Table:
    """The rows of `assignment_rows` for the console; blocks without cameras stand out."""
    table = Table(box=box.SIMPLE_HEAD, title="blocks and their cameras", title_justify="left")
    for _, heading, _ in TABLE_COLUMNS:
        table.add_column(heading, justify="right", vertical="bottom")
    for row in rows:
        values = [(getattr(row, name), form) for name, _, form in TABLE_COLUMNS]
        cells = ["–" if value is None else form.format(value) for value, form in values]
        table.add_row(*cells, style="" if row.cameras else "yellow")
    return table
