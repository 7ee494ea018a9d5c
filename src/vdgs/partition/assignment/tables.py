"""What assignment decided, for people and for JSON: each block in a row, and each pair of view and block."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from rich import box
from rich.table import Table

from vdgs.errors import RunError
from vdgs.partition.assignment.assign import ABOVE_THRESHOLD, BEST_BLOCK, TOPPED_UP, WHY, Assignment
from vdgs.partition.assignment.scores import Scores
from vdgs.partition.blocks import Blocks, places_of

Row = dict[str, Any]


def explain(
    names: Sequence[str], scores: Scores, assignment: Assignment, *, view: str | None = None, block: int | None = None
) -> list[Row]:
    """Why views were chosen, or not: a row for each pair, the assigned pairs first, then by falling score.

    Keys: view, block, score, covered (None where it was not measured), held, why (a phrase). `view` and `block` narrow
    the answer. Raises RunError for a view or a block that is not there.
    """
    if view is not None and view not in names:
        raise RunError(f"There is no training view {view!r}. Views are named as in the capture, such as {names[0]!r}.")
    if block is not None and not 0 <= block < len(scores.anchors):
        raise RunError(f"There is no block {block}; blocks are numbered 0 to {len(scores.anchors) - 1}.")
    rows = [
        {
            "view": names[c],
            "block": b,
            "score": float(scores.scores[c, b]),
            "covered": None if np.isnan(scores.covered[c, b]) else float(scores.covered[c, b]),
            "held": int(scores.held[c, b]),
            "why": WHY[assignment.why[c, b]],
        }
        for c in range(len(names))
        if view in (None, names[c])
        for b in range(len(scores.anchors))
        if block in (None, b)
    ]
    return sorted(rows, key=lambda row: (row["why"] == WHY[0], -row["score"]))


def assignment_rows(
    blocks: Blocks, positions: Float[np.ndarray, "n 3"], visibility: Int[np.ndarray, " n"], assignment: Assignment
) -> list[Row]:
    """A row for each block: cameras by reason, anchors in core and widened block, mean and standard deviation
    of V_i, area of the core.

    Areas are in square units of the ground frame; `mean_v` is None for a block without anchors. Ready for JSON.
    """
    places = places_of(positions)
    owner = blocks.owner(places)
    rows = []
    for index, block in enumerate(blocks.items):
        own, why = owner == index, assignment.why[:, index]
        rows.append(
            {
                "block": index,
                "cameras": int(np.count_nonzero(why)),
                "above_threshold": int(np.count_nonzero(why == ABOVE_THRESHOLD)),
                "best_block": int(np.count_nonzero(why == BEST_BLOCK)),
                "topped_up": int(np.count_nonzero(why == TOPPED_UP)),
                "anchors_core": int(np.count_nonzero(own)),
                "anchors_expanded": int(np.count_nonzero(blocks.reaches(index, places))),
                "mean_v": float(visibility[own].mean()) if own.any() else None,
                "std_v": float(visibility[own].std()) if own.any() else None,
                "area": float(block.core.area),
            }
        )
    return rows


#: key of a row, heading, format
COLUMNS = (
    ("block", "block", "{}"),
    ("cameras", "cameras", "{:,}"),
    ("added", "added", "{:,}"),
    ("anchors_core", "anchors", "{:,}"),
    ("anchors_expanded", "widened", "{:,}"),
    ("mean_v", "mean V", "{:.1f}"),
    ("area", "area", "{:,.0f}"),
)


def assignment_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """The rows of `assignment_rows` for the console; blocks without cameras stand out.

    "added" are cameras below the threshold: their best block, or topped up."""
    table = Table(box=box.SIMPLE_HEAD, title="blocks and their cameras", title_justify="left")
    for _, heading, _ in COLUMNS:
        table.add_column(heading, justify="right", vertical="bottom")
    for row in ({**row, "added": row["best_block"] + row["topped_up"]} for row in rows):
        cells = ["–" if row[key] is None else form.format(row[key]) for key, _, form in COLUMNS]
        table.add_row(*cells, style="" if row["cameras"] else "yellow")
    return table
