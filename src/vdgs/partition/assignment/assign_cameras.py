"""Which cameras train which block, decided from the score matrix (section IV-B).

The paper assigns a camera where its score is above a threshold. Alone, that leaves cameras without any block and
blocks without any camera; so (choice) every camera also joins its best block, and every block is topped up with its
best views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int8

from vdgs.config.method import AssignmentConfig
from vdgs.partition.assignment.score_matrix import ScoreMatrix

#: What the numbers in `Assignment.why` mean.
NOT_ASSIGNED, ABOVE_THRESHOLD, BEST_BLOCK, TOPPED_UP = range(4)
REASONS = ("not assigned", "above the threshold", "the view's best block", "topped up")


@dataclass(frozen=True, eq=False)
class Assignment:
    """The cameras of every block: rows are cameras, columns blocks."""

    cameras: Bool[np.ndarray, "c b"]
    #: The first reason that applied, as an index of `REASONS`.
    reasons: Int8[np.ndarray, "c b"]
    #: One sentence for each block that has no camera, or that none of the cameras sees.
    warnings: list[str]


def assign_cameras(scores: ScoreMatrix, config: AssignmentConfig) -> Assignment:
    """Decide from the scores; the threshold is that of the mode in which they were made.

    1. A camera whose score is above the threshold joins, if its frustum holds any anchor of the block's core: without
       one it has nothing to teach. Mode `literal` asks the score alone, as printed.
    2. Every camera joins its best block among those of which it holds an anchor. One that holds none joins the block
       with the best score, or where all are 0 the one beneath it: every camera serves at least one block. Not so
       without `config.best_block`.
    3. Every block with fewer than `config.min_cameras` is topped up with the best of the cameras that hold an anchor of
       it, until it has so many or all of them.

    "Best" is by score, among equals by anchors held, then by index.
    """
    seen = scores.visible_anchors > 0
    threshold = config.threshold_leave_one_out if scores.mode == "leave-one-out" else config.threshold
    why = np.zeros(scores.scores.shape, np.int8)
    why[(scores.scores > threshold) & (seen | (scores.mode == "paper"))] = ABOVE_THRESHOLD
    if config.always_best:
        rows, best = np.arange(len(why)), _best_blocks(scores)
        why[rows, best] = np.where(why[rows, best] == NOT_ASSIGNED, BEST_BLOCK, why[rows, best])
    for block in range(len(scores.anchors)):
        missing = max(config.min_cameras - np.count_nonzero(why[:, block]), 0)
        order = np.lexsort((-scores.visible_anchors[:, block], -scores.scores[:, block]))
        candidates = order[seen[order, block] & (why[order, block] == NOT_ASSIGNED)]
        why[candidates[:missing], block] = TOPPED_UP
    return Assignment(why != NOT_ASSIGNED, why, _warnings(scores, why, threshold))


def _best_blocks(scores: ScoreMatrix) -> np.ndarray:
    """The best block of every camera, [c]."""
    if not len(scores.scores):
        return np.zeros(0, np.int64)
    seen = scores.visible_anchors > 0
    best = np.lexsort((-scores.visible_anchors, -scores.scores, ~seen), axis=-1)[:, 0]
    blank = ~seen.any(axis=1) & (scores.scores.max(axis=1) == scores.scores.min(axis=1))
    return np.where(blank, scores.nadir_block, best)


def _warnings(scores: ScoreMatrix, why: np.ndarray, threshold: float) -> list[str]:
    complaints = []
    for block, anchors in enumerate(scores.anchors):
        watching = int(np.count_nonzero(scores.visible_anchors[:, block]))
        if anchors == 0:
            complaints.append(f"Block {block} holds no anchors. Cut the scene into fewer blocks: --blocks.")
        elif watching == 0:
            complaints.append(
                f"Block {block}: no training camera sees any of its {anchors:,} anchors. It cannot be trained; the "
                "coarse anchors stay. Fewer blocks (--blocks) would join it to one that is seen."
            )
        elif not why[:, block].any():
            complaints.append(
                f"Block {block}: {watching} training camera(s) see some of its {anchors:,} anchors, but none scores "
                f"above {threshold:g} (best: {scores.scores[:, block].max():.3g}). Lower --assignment.threshold or "
                "raise --assignment.min-cameras."
            )
    return complaints
