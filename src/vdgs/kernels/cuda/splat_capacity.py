"""How many splats room is made for before anybody knows how many there are."""

from __future__ import annotations

import torch

#: Room beyond what the views before needed, in parts of it and in splats.
MARGIN_FACTOR, MARGIN_SPLATS = 1.125, 256
#: What a view needed counts this much less with each that follows.
DECAY = 0.98


class SplatCapacity:
    """Splats for each anchor in view, on each device: the most that recent views needed.

    Views, models and threads share it: what it says costs memory or a second pass, never a bit of the result.
    """

    def __init__(self) -> None:
        self._shares: dict[tuple[str, int], float] = {}

    def estimate(self, count: int, offsets: int, device: torch.device) -> int:
        """Splats to make room for, of so many anchors with so many offsets: half of these until a view is known."""
        share = self._shares.get((str(device), offsets), offsets / 2)
        return min(int(MARGIN_FACTOR * share * count) + MARGIN_SPLATS, count * offsets)

    def update(self, count: int, offsets: int, device: torch.device, splats: int) -> None:
        """So many splats they were."""
        if count:
            key = str(device), offsets
            self._shares[key] = max(splats / count, DECAY * self._shares.get(key, 0.0))
