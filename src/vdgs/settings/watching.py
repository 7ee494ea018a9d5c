"""Options that change how a run is watched and saved, never its result."""

from __future__ import annotations

from dataclasses import dataclass

from vdgs.errors import VdgsError


@dataclass(frozen=True)
class WatchOptions:
    """What does not change the result: how training is watched and saved."""

    save_every: int = 1000
    """Iterations between two checkpoints."""
    image_memory_gb: float = 0.0
    """Memory for decoded images; 0 takes a quarter of what is free."""
    tensorboard: bool = False
    """Also write TensorBoard events into the stage's folder (needs the extra `tensorboard`)."""

    def check(self) -> None:
        """Raise VdgsError for values that do not work."""
        if self.save_every < 1 or self.image_memory_gb < 0:
            raise VdgsError("--save-every must be at least 1 and --image-memory-gb must not be negative")
