"""Splats that do not stand in the order of their anchors, and what tells where they are.

On a card, blocks of threads write the splats of some anchors each, and which block comes first is left to the card.
Within a block's run they are in order, so that a number or two for each run say all.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int32
from torch import Tensor

#: Consecutive visible anchors whose splats make one run of `SplatMask`: warps of a block of source/decode.cu.
ANCHORS_PER_SEGMENT = 8


@dataclass(frozen=True, eq=False)
class SplatSegments:
    """Where m splats stand that are ordered within runs, and the runs in any way: r of them, which may be empty."""

    #: The row at which each run begins, and how many rows it has; runs are named in the order that is meant.
    starts: Int32[Tensor, " r"]
    lengths: Int32[Tensor, " r"]

    def order(self, m: int) -> Int32[Tensor, " m"]:
        """The rows of the m splats in the order that is meant. Nothing waits for a card."""
        ends = self.lengths.cumsum(0, dtype=torch.int32)
        place = torch.arange(m, dtype=torch.int32, device=ends.device)
        shift = self.starts - ends + self.lengths
        return place + shift[torch.searchsorted(ends, place, right=True)]

    @staticmethod
    def concat(
        first: SplatSegments | None, m: int, second: SplatSegments | None, n: int, device: torch.device
    ) -> SplatSegments | None:
        """Those of m splats followed by n others; None is one run, as the rows are."""
        if first is None and second is None:
            return None
        first, second = first or SplatSegments.single(m, device), second or SplatSegments.single(n, device)
        return SplatSegments(torch.cat([first.starts, second.starts + m]), torch.cat([first.lengths, second.lengths]))

    @staticmethod
    def single(m: int, device: torch.device) -> SplatSegments:
        """m splats as the rows are."""
        return SplatSegments(*(torch.full((1,), number, dtype=torch.int32, device=device) for number in (0, m)))


@dataclass(frozen=True, eq=False)
class SplatMask:
    """Which offsets each of v visible anchors shows, and where their m splats stand: in place of `source`
    (`AnchorSplats`), of which it has an eighth of the bytes."""

    #: Bit o is set where offset o has a splat; splats of an anchor are in the order of offsets.
    bits: Int32[Tensor, " v"]
    #: Of `ANCHORS_PER_SEGMENT` anchors each.
    segments: SplatSegments
    count: int
    offsets: int

    def __len__(self) -> int:
        return self.count

    @staticmethod
    def of(source: Int32[Tensor, " m"], v: int, offsets: int) -> SplatMask:
        """From ascending sources. Nothing waits for a card."""
        anchor, offset = source // offsets, source % offsets
        bits = torch.zeros(v, dtype=torch.int32, device=source.device)
        bits.index_add_(0, anchor, torch.ones_like(source) << offset)
        firsts = (
            torch.arange(0, v + ANCHORS_PER_SEGMENT, ANCHORS_PER_SEGMENT, device=source.device).clamp(max=v) * offsets
        )
        bounds = torch.searchsorted(source, firsts.to(torch.int32), out_int32=True)
        return SplatMask(bits, SplatSegments(bounds[:-1].contiguous(), bounds.diff()), len(source), offsets)


def sources_tensor(source: Tensor | SplatMask) -> Tensor:
    """Sources as a tensor. Raises TypeError for `SplatMask`, which only kernels of a card can read."""
    if isinstance(source, SplatMask):
        raise TypeError("splats that a card has decoded for training can only be used on that card")
    return source
