"""What a stage says of itself in status.json: where it stands, or how it ended."""

from __future__ import annotations

from dataclasses import dataclass

from vdgs.partition.block_records import MergedBlock


@dataclass(frozen=True, kw_only=True)
class Status:
    """status.json; None for what a stage does not say."""

    state: str = "new"
    """new (nothing is written yet), queued, running, stopped, done or failed."""
    why: str | None = None
    """Why it failed or stopped, or has nothing to train."""
    iteration: int | None = None
    iterations: int | None = None
    photographs: float | None = None
    """How many photographs' worth of pixels were drawn; None where every iteration draws a whole one."""
    anchors: int | None = None
    psnr_training: float | None = None
    seconds: float | None = None
    seconds_left: int | None = None
    peak_memory_bytes: int | None = None
    model: str | None = None
    """What tells the finished model from any other (`storage.tensors.identity`)."""

    # Of a merged scene:
    blocks_trained: int | None = None
    blocks: tuple[MergedBlock, ...] | None = None
    block_models: tuple[str | None, ...] | None = None
    """`model` of each block; None for one that is missing."""
    merge_seconds: float | None = None
    merge_peak_memory_bytes: int | None = None
