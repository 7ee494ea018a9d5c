"""The cut of a run, opened: its blocks, and which training views serve each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from vdgs.captures.capture import Capture
from vdgs.errors import RunError
from vdgs.partition.assignment.score_file import load_scores
from vdgs.partition.blocks import Blocks, load_blocks
from vdgs.runs.run_folder import RunFolder


def blocks_of(run: RunFolder) -> Blocks:
    """The blocks of a run, with cameras. Raises RunError unless they were made with the run's settings."""
    record, keys = run.partition_record(), run.keys()
    if (record.key, record.assignment_key) != (keys.partition, keys.assignment):
        raise RunError(
            f"{run.path}: is not cut into blocks yet, or with other settings. Run: vdgs partition {run.path}"
        )
    return load_blocks(run.partition / "blocks.geojson")


def views_of_block(run: RunFolder, capture: Capture, index: int) -> list[int]:
    """Which training views, by number, serve a block."""
    return _views(_assigned(run, capture)[:, index])


def views_of_blocks(run: RunFolder, capture: Capture) -> list[list[int]]:
    """The same of every block, read once."""
    return [_views(of_block) for of_block in _assigned(run, capture).T]


def _views(assigned: Bool[np.ndarray, " c"]) -> list[int]:
    return [int(view) for view in np.flatnonzero(assigned)]


def _assigned(run: RunFolder, capture: Capture) -> Bool[np.ndarray, "c b"]:
    """Which training view serves which block. Raises RunError where that is of other views."""
    _, _, assignment = load_scores(run.partition / "scores.npz")
    if len(assignment.cameras) != len(capture.train_views):
        raise RunError(f"{run.partition / 'scores.npz'}: is of another capture. Run: vdgs partition {run.path}")
    return assignment.cameras
