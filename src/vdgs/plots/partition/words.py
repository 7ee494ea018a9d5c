"""Colours and words that the figures of the partition share."""

from __future__ import annotations

from matplotlib.colors import to_rgb

#: Colours of blocks 0 to 15; block 16 begins anew. Neighbours in the list differ most.
PALETTE = (
    "#4363d8", "#f58231", "#3cb44b", "#e6194b", "#911eb4", "#42c6e0", "#e0bd00", "#f032e6",
    "#9a6324", "#469990", "#a3cf3f", "#000075", "#f0a3c0", "#800000", "#b79be6", "#808000",
)  # fmt: skip


def block_colour(index: int) -> str:
    """The colour of a block in all figures."""
    return PALETTE[index % len(PALETTE)]


def count_of(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def mixed(colour: str, scale: float, tone: float = 1.0) -> tuple[float, float, float]:
    """The colour darkened by `scale`, then mixed with white; 1 and 1 leave it."""
    red, green, blue = (1 - tone * (1 - scale * part) for part in to_rgb(colour))
    return red, green, blue
