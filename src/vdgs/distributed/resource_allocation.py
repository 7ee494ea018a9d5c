"""How a place is shared out among pieces of work: how many at once, with how many threads and how much memory each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from vdgs.config.executor_options import ExecutorOptions
from vdgs.distributed.executor import Needs
from vdgs.distributed.job_labels import BLOCKS, Kind
from vdgs.distributed.shard_runner import default_jobs

#: Processors of a piece where nobody knows how many there are (choice).
PROCESSORS = 4
#: Share of its memory that a piece keeps decoded photographs in, and GB where nobody knows how much there is (choice).
IMAGES_SHARE, IMAGES_GB = 0.25, 1.0
#: GB for photographs at least (choice): those of a step and of the next.
LEAST_IMAGES_GB = 0.1


class Place(Protocol):
    """A machine that pieces can be sent to."""

    @property
    def processors(self) -> int:
        """At least one."""

    @property
    def memory_bytes(self) -> int:
        """0 where it does not say."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What is to be shared out."""

    pieces: int
    piece_bytes: int
    """What the largest piece takes by estimate, beside its photographs."""
    jobs: int = 0
    """Pieces at once that a person asked for; 0: as many as there is room for."""
    image_gb: float = 0.0
    """Memory for photographs that a person asked for; 0: by the memory that there is."""
    kind: Kind = BLOCKS
    photographs_bytes: int = 0
    """What all photographs of a piece take at most, decoded; 0 where it keeps none."""


@dataclass(frozen=True)
class Share:
    """What a piece gets."""

    at_once: int
    needs: Needs
    image_gb: float


def on_this_machine(work: Work, cores: int, free_bytes: int) -> Share:
    """Of one machine: as many pieces at once as there are cores and memory for.

    Photographs share one budget: what a person asked for, else a quarter of what is free, or less where pieces leave
    less.
    """
    asked = 1e9 * work.image_gb
    budget = asked or IMAGES_SHARE * free_bytes
    at_once, threads = max(
        default_jobs(work.pieces, cores, max(0, int(free_bytes - budget)), work.piece_bytes),
        # Where all photographs take less than the budget.
        default_jobs(work.pieces, cores, free_bytes, work.piece_bytes + work.photographs_bytes),
    )
    if work.jobs:
        at_once = min(work.jobs, work.pieces)
        threads = max(1, cores // at_once)
    if not asked:
        budget = min(budget, max(1e9 * LEAST_IMAGES_GB * at_once, free_bytes - at_once * work.piece_bytes))
    return Share(at_once, Needs(threads, work.piece_bytes), budget / 1e9 / at_once)


def exceeds(work: Work, at_once: int, free_bytes: int) -> bool:
    """Whether so many pieces at once may take more than one machine has free, with the least for photographs where
    nobody asked for more."""
    budget = 1e9 * (work.image_gb or LEAST_IMAGES_GB * at_once)
    return at_once * work.piece_bytes + min(budget, at_once * work.photographs_bytes) > free_bytes


def on_cluster(work: Work, places: Sequence[Place], asked: ExecutorOptions) -> Share:
    """Of machines that are known: all pieces at once if there are processors for that, with as many as each can have.

    A piece asks for the memory that it takes by estimate and for its photographs, or for all of the largest machine
    where that is less. `Work.image_gb` is of one piece here.
    """
    at_once = min(work.pieces, work.jobs or work.pieces)
    processors = asked.processors or _processors(at_once, places)
    most = max(place.memory_bytes for place in places)
    whole = max(places, key=lambda place: place.memory_bytes)
    share = whole.memory_bytes * min(1, processors / whole.processors) / 1e9
    beside = max(LEAST_IMAGES_GB, share - work.piece_bytes / 1e9)
    images = work.image_gb or min(IMAGES_SHARE * share, beside)
    wanted = round(1e9 * asked.memory_gb) or work.piece_bytes + round(1e9 * images)
    memory = wanted if asked.memory_gb or not most else min(wanted, most)
    return Share(at_once, Needs(processors, memory if most else 0, asked.gpus), images)


def by_queue(work: Work, asked: ExecutorOptions) -> Share:
    """Of machines that nobody knows before jobs start."""
    at_once = min(work.pieces, work.jobs or work.pieces)
    images = work.image_gb or IMAGES_GB
    memory = round(1e9 * asked.memory_gb) or work.piece_bytes + round(1e9 * images)
    return Share(at_once, Needs(asked.processors or PROCESSORS, memory, asked.gpus), images)


def _processors(at_once: int, places: Sequence[Place]) -> int:
    """The largest number of processors with which so many pieces find room at once; 1 if none do."""
    most = max(place.processors for place in places)
    fitting = [each for each in range(1, most + 1) if sum(place.processors // each for place in places) >= at_once]
    return max(fitting, default=1)
