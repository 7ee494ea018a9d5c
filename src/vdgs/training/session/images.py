"""Memory for decoded photographs while training runs."""

from __future__ import annotations

from vdgs.config.checkpointing import WatchOptions
from vdgs.system.memory.process_memory import available_bytes


def image_budget(options: WatchOptions) -> int:
    """Bytes for decoded photographs."""
    return int(options.image_memory_gb * 1e9) or available_bytes() // 4
