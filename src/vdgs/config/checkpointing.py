"""Options that change how a run is watched and saved, never its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from vdgs.config.ranges import MAX_COUNT, MAX_FLOAT, Range, check_ranges


@dataclass(frozen=True)
class CheckpointOptions:
    """What does not change the result: how training is watched and saved."""

    save_every: Annotated[int, Range(1, MAX_COUNT)] = 1000
    """Iterations between two checkpoints."""
    image_cache_gb: Annotated[float, Range(0, MAX_FLOAT)] = 0.0
    """Memory for decoded images; 0 takes a quarter of what is free. On a cluster: of one block."""
    tensorboard: bool = False
    """Also write TensorBoard events into the stage's folder (needs the extra `tensorboard`)."""

    def check(self) -> None:
        """Raise VdgsError for values that do not work."""
        check_ranges(self)
