"""The color of a block in all figures; without what draws them."""

from __future__ import annotations

#: Colors of blocks 0 to 15; block 16 begins anew. Neighbors in the list differ most.
BLOCK_PALETTE = (
    "#4363d8", "#f58231", "#3cb44b", "#e6194b", "#911eb4", "#42c6e0", "#e0bd00", "#f032e6",
    "#9a6324", "#469990", "#a3cf3f", "#000075", "#f0a3c0", "#800000", "#b79be6", "#808000",
)  # fmt: skip


def block_color(index: int) -> str:
    """The color of a block in all figures."""
    return BLOCK_PALETTE[index % len(BLOCK_PALETTE)]
