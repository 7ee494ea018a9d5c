"""Memory for decoded photographs while training runs."""

from __future__ import annotations

from vdgs.memory.process import available_bytes
from vdgs.settings.watching import WatchOptions


def image_budget(options: WatchOptions) -> int:
    """Bytes for decoded photographs."""
    return int(options.image_memory_gb * 1e9) or available_bytes() // 4
