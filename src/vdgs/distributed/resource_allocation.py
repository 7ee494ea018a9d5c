"""How a place is shared out among pieces of work: how many at once, with how many threads and how much memory each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from vdgs.config.executor_options import ExecutorOptions
from vdgs.distributed.executor import TaskResources
from vdgs.distributed.job_labels import BLOCK_LABELS, JobLabels
from vdgs.distributed.shard_runner import default_jobs

#: Processors of a piece where nobody knows how many there are (choice).
DEFAULT_CPUS = 4
#: Share of its memory that a piece keeps decoded photographs in, and GB where nobody knows how much there is (choice).
IMAGE_MEMORY_SHARE, DEFAULT_IMAGE_GB = 0.25, 1.0
#: GB for photographs at least (choice): those of a step and of the next.
MIN_IMAGE_GB = 0.1


class NodeResources(Protocol):
    """A machine that pieces can be sent to."""

    @property
    def cpus(self) -> int:
        """At least one."""

    @property
    def memory_bytes(self) -> int:
        """0 where it does not say."""


@dataclass(frozen=True, kw_only=True)
class ShardWorkload:
    """What is to be shared out."""

    pieces: int
    shard_bytes: int
    """What the largest piece takes by estimate, beside its photographs."""
    jobs: int = 0
    """Pieces at once that a person asked for; 0: as many as there is room for."""
    image_gb: float = 0.0
    """Memory for photographs that a person asked for; 0: by the memory that there is."""
    kind: JobLabels = BLOCK_LABELS
    images_bytes: int = 0
    """What all photographs of a piece take at most, decoded; 0 where it keeps none."""


@dataclass(frozen=True)
class Allocation:
    """What a piece gets."""

    max_concurrent: int
    resources: TaskResources
    image_gb: float


def allocate_local(workload: ShardWorkload, cores: int, free_bytes: int) -> Allocation:
    """Of one machine: as many pieces at once as there are cores and memory for.

    Photographs share one budget: what a person asked for, else a quarter of what is free, or less where pieces leave
    less.
    """
    asked = 1e9 * workload.image_gb
    budget = asked or IMAGE_MEMORY_SHARE * free_bytes
    at_once, threads = max(
        default_jobs(workload.pieces, cores, max(0, int(free_bytes - budget)), workload.shard_bytes),
        # Where all photographs take less than the budget.
        default_jobs(workload.pieces, cores, free_bytes, workload.shard_bytes + workload.images_bytes),
    )
    if workload.jobs:
        at_once = min(workload.jobs, workload.pieces)
        threads = max(1, cores // at_once)
    if not asked:
        budget = min(budget, max(1e9 * MIN_IMAGE_GB * at_once, free_bytes - at_once * workload.shard_bytes))
    return Allocation(at_once, TaskResources(threads, workload.shard_bytes), budget / 1e9 / at_once)


def exceeds_memory(workload: ShardWorkload, at_once: int, free_bytes: int) -> bool:
    """Whether so many pieces at once may take more than one machine has free, with the least for photographs where
    nobody asked for more."""
    budget = 1e9 * (workload.image_gb or MIN_IMAGE_GB * at_once)
    return at_once * workload.shard_bytes + min(budget, at_once * workload.images_bytes) > free_bytes


def allocate_cluster(
    workload: ShardWorkload, nodes: Sequence[NodeResources], executor_options: ExecutorOptions
) -> Allocation:
    """Of machines that are known: all pieces at once if there are processors for that, with as many as each can have.

    A piece asks for the memory that it takes by estimate and for its photographs, or for all of the largest machine
    where that is less. `Work.image_gb` is of one piece here.
    """
    at_once = min(workload.pieces, workload.jobs or workload.pieces)
    processors = executor_options.cpus or _max_cpus(at_once, nodes)
    most = max(place.memory_bytes for place in nodes)
    whole = max(nodes, key=lambda place: place.memory_bytes)
    share = whole.memory_bytes * min(1, processors / whole.cpus) / 1e9
    beside = max(MIN_IMAGE_GB, share - workload.shard_bytes / 1e9)
    images = workload.image_gb or min(IMAGE_MEMORY_SHARE * share, beside)
    wanted = round(1e9 * executor_options.mem_gb) or workload.shard_bytes + round(1e9 * images)
    memory = wanted if executor_options.mem_gb or not most else min(wanted, most)
    return Allocation(at_once, TaskResources(processors, memory if most else 0, executor_options.gpus), images)


def allocate_queue(workload: ShardWorkload, executor_options: ExecutorOptions) -> Allocation:
    """Of machines that nobody knows before jobs start."""
    at_once = min(workload.pieces, workload.jobs or workload.pieces)
    images = workload.image_gb or DEFAULT_IMAGE_GB
    memory = round(1e9 * executor_options.mem_gb) or workload.shard_bytes + round(1e9 * images)
    return Allocation(
        at_once, TaskResources(executor_options.cpus or DEFAULT_CPUS, memory, executor_options.gpus), images
    )


def _max_cpus(at_once: int, nodes: Sequence[NodeResources]) -> int:
    """The largest number of processors with which so many pieces find room at once; 1 if none do."""
    most = max(place.cpus for place in nodes)
    fitting = [each for each in range(1, most + 1) if sum(place.cpus // each for place in nodes) >= at_once]
    return max(fitting, default=1)
