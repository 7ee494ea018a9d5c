"""Options that change how a run is watched and saved, never its result."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CoarseOptions:
    """What does not change the result: how a run is watched and saved."""

    save_every: int = 1000
    """Iterations between two saved states."""
    image_memory_gb: float = 0.0
    """Memory for decoded images; 0 takes a quarter of what is free."""
    tensorboard: bool = False
    """Also write TensorBoard events into the stage's folder (needs the extra `tensorboard`)."""
