"""What stages send out: how their shards are called, and what of them is worth showing."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class JobLabels:
    """The words for the shards of a stage."""

    singular: str
    plural: str
    verb: str
    """What is to be done with one: "train"."""
    activity: str
    """What it is at work with: "training"."""
    step_unit: str
    """What the numbers of `iteration` and `iterations` in its status file count, as the head of a column."""
    rate_unit: str
    """So many of them a second."""
    shows_training_stats: bool = False
    """Whether it tells of anchors and PSNR while it runs."""
    memory_saving_options: tuple[str, ...] = ()
    """Options that let one take less memory."""


BLOCK_LABELS = JobLabels(
    singular="block",
    plural="blocks",
    verb="train",
    activity="training",
    step_unit="iteration",
    rate_unit="it/s",
    shows_training_stats=True,
    memory_saving_options=("more --blocks", "--block.densify.max-anchors"),
)


def shard_kind(work: str, steps: str) -> JobLabels:
    """The words for shards that do something (`measure`) with items (`views`)."""
    return JobLabels(
        singular="shard", plural="shards", verb=work, activity="at work", step_unit=steps, rate_unit=f"{steps}/s"
    )
