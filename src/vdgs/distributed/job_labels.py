"""What stages send out: how their shards are called, and what of them is worth showing."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Kind:
    """The words for the shards of a stage."""

    one: str
    many: str
    work: str
    """What is to be done with one: "train"."""
    doing: str
    """What it is at work with: "training"."""
    steps: str
    """What the numbers of `iteration` and `iterations` in its status file count, as the head of a column."""
    pace: str
    """So many of them a second."""
    trains: bool = False
    """Whether it tells of anchors and PSNR while it runs."""
    smaller: tuple[str, ...] = ()
    """Options that let one take less memory."""


BLOCKS = Kind(
    one="block", many="blocks", work="train", doing="training", steps="iteration", pace="it/s", trains=True,
    smaller=("more --blocks", "--block.growth.max-anchors"),
)  # fmt: skip


def shard_kind(work: str, steps: str) -> Kind:
    """The words for shards that do something (`measure`) with items (`views`)."""
    return Kind(one="shard", many="shards", work=work, doing="at work", steps=steps, pace=f"{steps}/s")
