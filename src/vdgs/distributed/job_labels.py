"""How the shards of a stage are called, and what of them is worth showing."""

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
    """The unit of `iteration` and `iterations` in its status file, as the head of a column."""
    rate_unit: str
    shows_training_stats: bool = False
    """Whether its status file has anchors and PSNR."""
    memory_saving_options: tuple[str, ...] = ()


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


def shard_kind(verb: str, unit: str) -> JobLabels:
    """The words for shards that do something (`measure`) with items (`views`)."""
    return JobLabels(
        singular="shard", plural="shards", verb=verb, activity="at work", step_unit=unit, rate_unit=f"{unit}/s"
    )
