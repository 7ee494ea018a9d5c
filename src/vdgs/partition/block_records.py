"""What cutting, assignment and merging note of each block, for later stages, files and people."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BlockRecord:
    """A block of a cut."""

    block: int
    anchors_core: int
    area: float
    """Of the core, in square units of the ground frame."""
    mean_v: float | None
    """Mean and standard deviation of V_i over the anchors of the core; None where there is none."""
    std_v: float | None


@dataclass(frozen=True, kw_only=True)
class BlockCamerasRecord:
    """A block of a cut with its cameras, by the reason that brought them, and the anchors of core and widened block.

    `mean_v`, `std_v` and `area` as in `BlockRecord`.
    """

    block: int
    cameras: int
    above_threshold: int
    best_block: int
    topped_up: int
    anchors_core: int
    anchors_expanded: int
    mean_v: float | None
    std_v: float | None
    area: float

    @property
    def extra_cameras(self) -> int:
        """Cameras below the threshold: their best block, or topped up."""
        return self.best_block + self.topped_up


@dataclass(frozen=True, kw_only=True)
class PartitionRecord:
    """partition.json: how a scene was cut. None and nothing of one that is not cut yet."""

    key: str | None = None
    assignment_key: str | None = None
    strategy: str | None = None
    lambda_vis: float | None = None
    warnings: tuple[str, ...] = ()
    assignment_warnings: tuple[str, ...] = ()
    blocks: tuple[BlockCamerasRecord, ...] = ()
    spatial_only_blocks: tuple[BlockRecord, ...] = ()
    """The cut that place alone would give, to compare with where visibility has a part in the cut."""
    seconds: float | None = None
    """Of the cut and the assignment; without the figures and the cut to compare with."""
    peak_memory_bytes: int | None = None


@dataclass(frozen=True, kw_only=True)
class MergedBlockRecord:
    """What became of the anchors of a block when the scene was merged."""

    block: int
    trained: int
    kept: int
    dropped: int
    coarse_fallback: int
    """Coarse anchors that stand in for a block that is missing."""
    unseen: int
    """Kept, but in the frustum of none of the block's cameras."""
