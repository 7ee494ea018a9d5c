"""The order of splats that a GPU wrote in segments: each block of threads writes the splats of its anchors in order,
and the blocks finish in any order."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int32
from torch import Tensor

#: Consecutive visible anchors whose splats make one run of `SplatMask`: warps of a block of source/decode.cu.
ANCHORS_PER_SEGMENT = 8


@dataclass(frozen=True, eq=False)
class SplatSegments:
    """r segments of m splats, in the order that is meant; a segment may be empty."""

    #: The first row of each segment, and its number of rows.
    starts: Int32[Tensor, " r"]
    lengths: Int32[Tensor, " r"]

    def order(self, m: int) -> Int32[Tensor, " m"]:
        """The rows of the m splats in the order that is meant. Does not wait for a GPU."""
        ends = self.lengths.cumsum(0, dtype=torch.int32)
        place = torch.arange(m, dtype=torch.int32, device=ends.device)
        shift = self.starts - ends + self.lengths
        return place + shift[torch.searchsorted(ends, place, right=True)]

    @staticmethod
    def concat(
        first: SplatSegments | None, m: int, second: SplatSegments | None, n: int, device: torch.device
    ) -> SplatSegments | None:
        """The segments of m splats followed by n others; None is one segment."""
        if first is None and second is None:
            return None
        first, second = first or SplatSegments.single(m, device), second or SplatSegments.single(n, device)
        return SplatSegments(torch.cat([first.starts, second.starts + m]), torch.cat([first.lengths, second.lengths]))

    @staticmethod
    def single(m: int, device: torch.device) -> SplatSegments:
        """m splats in the order of the rows."""
        return SplatSegments(*(torch.full((1,), number, dtype=torch.int32, device=device) for number in (0, m)))


@dataclass(frozen=True, eq=False)
class SplatMask:
    """Which offsets of each of v visible anchors have a splat, and the segments of their m splats:
    `AnchorSplats.source` in an eighth of the bytes."""

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
        """From ascending sources. Does not wait for a GPU."""
        anchor, offset = source // offsets, source % offsets
        bits = torch.zeros(v, dtype=torch.int32, device=source.device)
        bits.index_add_(0, anchor, torch.ones_like(source) << offset)
        anchors = torch.arange(0, v + ANCHORS_PER_SEGMENT, ANCHORS_PER_SEGMENT, device=source.device).clamp(max=v)
        bounds = torch.searchsorted(source, (anchors * offsets).to(torch.int32), out_int32=True)
        return SplatMask(bits, SplatSegments(bounds[:-1].contiguous(), bounds.diff()), len(source), offsets)


def sources_tensor(source: Tensor | SplatMask) -> Tensor:
    """Sources as a tensor. Raises TypeError for `SplatMask`, which only kernels of a card can read."""
    if isinstance(source, SplatMask):
        raise TypeError("splats that a card has decoded for training can only be used on that card")
    return source
