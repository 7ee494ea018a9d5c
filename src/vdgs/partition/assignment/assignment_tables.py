"""What assignment decided, for people and files: each block in a row, and each pair of view and block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from rich import box
from rich.table import Table

from vdgs.errors import RunError
from vdgs.partition.assignment.assign_cameras import ABOVE_THRESHOLD, BEST_BLOCK, REASONS, TOPPED_UP, Assignment
from vdgs.partition.assignment.score_matrix import ScoreMatrix
from vdgs.partition.block_records import BlockCamerasRecord, BlockRecord
from vdgs.partition.blocks import Blocks, xy_positions


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
    owner = blocks.owner(xy_positions(positions))
    return tuple(
        BlockRecord(
            index, int((owner == index).sum()), float(block.core.area),
            mean_v=float(visibility[owner == index].mean()) if (owner == index).any() else None,
            std_v=float(visibility[owner == index].std()) if (owner == index).any() else None,
        )
        for index, block in enumerate(blocks.items)
    )  # fmt: skip


def assignment_rows(
    blocks: Blocks, positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"], assignment: Assignment
) -> list[BlockCamerasRecord]:
    """What was decided for each block."""
    places = xy_positions(positions)
    owner = blocks.owner(places)
    rows = []
    for index, block in enumerate(blocks.items):
        own, why = owner == index, assignment.reasons[:, index]
        rows.append(
            BlockCamerasRecord(
                block=index,
                cameras=int(np.count_nonzero(why)),
                above_threshold=int(np.count_nonzero(why == ABOVE_THRESHOLD)),
                best_block=int(np.count_nonzero(why == BEST_BLOCK)),
                topped_up=int(np.count_nonzero(why == TOPPED_UP)),
                anchors_core=int(np.count_nonzero(own)),
                anchors_expanded=int(np.count_nonzero(blocks.in_expanded(index, places, owner))),
                mean_v=float(visibility[own].mean()) if own.any() else None,
                std_v=float(visibility[own].std()) if own.any() else None,
                area=float(block.core.area),
            )
        )
    return rows


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
