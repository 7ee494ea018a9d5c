"""How many shards run at once on a machine, a cluster or a queue, with how many threads and how much memory each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from vdgs.config.executor_options import ExecutorOptions
from vdgs.distributed.executor import TaskResources
from vdgs.distributed.job_labels import BLOCK_LABELS, JobLabels

#: Processors of a shard where nobody knows how many there are (choice).
DEFAULT_CPUS = 4
#: Share of its memory in which a shard caches decoded images, and GB where nobody knows how much there is (choice).
IMAGE_MEMORY_SHARE, DEFAULT_IMAGE_GB = 0.25, 1.0
#: Shards at once on a card (choice: a step waits for the processor about as long as for the card), and what each takes
#: of its memory beside the estimate: the context, kernels, what torch keeps.
SHARDS_PER_CARD, CARD_OVERHEAD_BYTES = 2, 10**9
#: GB for images at least (choice): those of a step and of the next.
MIN_IMAGE_GB = 0.1


class NodeResources(Protocol):
    """A machine that shards can be sent to."""

    @property
    def cpus(self) -> int:
        """At least one."""

    @property
    def memory_bytes(self) -> int:
        """0 where it does not say."""


@dataclass(frozen=True, kw_only=True)
class ShardWorkload:
    """What is to be run."""

    shards: int
    shard_bytes: int
    """Memory of the largest shard by estimate, beside its images."""
    jobs: int = 0
    """Shards at once that were requested; 0: as many as there is room for."""
    image_gb: float = 0.0
    """Memory for images that was requested; 0: by the memory that there is."""
    kind: JobLabels = BLOCK_LABELS
    images_bytes: int = 0
    """All images of a shard, decoded; 0 where it caches none."""

    @property
    def max_concurrent(self) -> int:
        """Shards at once where the number of machines is no limit."""
        return min(self.shards, self.jobs or self.shards)


@dataclass(frozen=True)
class Allocation:
    """What a shard gets."""

    max_concurrent: int
    resources: TaskResources
    image_gb: float


@dataclass(frozen=True)
class MachineResources:
    """What this machine has; `cards` are the bytes of each GPU that shards may use."""

    cores: int
    free_bytes: int
    cards: tuple[int, ...] = ()

    def max_on_cards(self, shard_bytes: int) -> int:
        """How many shards of so many bytes find room on the cards, at least one on each."""
        room = max(1, int(0.9 * min(self.cards)) // (shard_bytes + CARD_OVERHEAD_BYTES))
        return len(self.cards) * min(SHARDS_PER_CARD, room)


def default_jobs(shards: int, cores: int, memory_available: int, memory_each: int) -> tuple[int, int]:
    """How many shards to run at once on the CPU, and with how many threads each (choice).

    As many as there are cores and memory (bytes) for, at least one: separate processes use cores better than the
    threads of one. The cores left over are shared out.
    """
    fit = memory_available // memory_each if memory_each > 0 else shards
    jobs = max(1, min(shards, cores, fit))
    return jobs, max(1, cores // jobs)


def allocate_local(workload: ShardWorkload, machine: MachineResources) -> Allocation:
    """On one machine: as many shards at once as there are cores, memory and, where these compute, cards for.

    Images share one budget: what was requested, else a quarter of what is free, or less where shards leave less.
    """
    cores, free_bytes = machine.cores, machine.free_bytes
    budget = 1e9 * workload.image_gb or IMAGE_MEMORY_SHARE * free_bytes
    at_once, threads = max(
        default_jobs(workload.shards, cores, max(0, int(free_bytes - budget)), workload.shard_bytes),
        # Where all images take less than the budget.
        default_jobs(workload.shards, cores, free_bytes, workload.shard_bytes + workload.images_bytes),
    )
    if workload.jobs or machine.cards:
        at_once = workload.max_concurrent if workload.jobs else min(at_once, machine.max_on_cards(workload.shard_bytes))
        threads = max(1, cores // at_once)
    if not workload.image_gb:
        budget = min(budget, max(1e9 * MIN_IMAGE_GB * at_once, free_bytes - at_once * workload.shard_bytes))
    return Allocation(at_once, TaskResources(threads, workload.shard_bytes), budget / 1e9 / at_once)


def exceeds_memory(workload: ShardWorkload, at_once: int, free_bytes: int) -> bool:
    """Whether so many shards at once may take more than one machine has free, with the least for images where nothing
    was requested."""
    budget = 1e9 * (workload.image_gb or MIN_IMAGE_GB * at_once)
    return at_once * workload.shard_bytes + min(budget, at_once * workload.images_bytes) > free_bytes


def allocate_cluster(workload: ShardWorkload, nodes: Sequence[NodeResources], options: ExecutorOptions) -> Allocation:
    """On machines that are known: all shards at once if there are processors for that, with as many as each can have.

    A shard asks for its memory by estimate and for that of its images, or for all of the largest machine where that is
    less. `workload.image_gb` is of one shard here.
    """
    at_once = workload.max_concurrent
    cpus = options.cpus or _max_cpus(at_once, nodes)
    largest = max(nodes, key=lambda node: node.memory_bytes)
    share = largest.memory_bytes * min(1, cpus / largest.cpus) / 1e9
    room = max(MIN_IMAGE_GB, share - workload.shard_bytes / 1e9)
    images = workload.image_gb or min(IMAGE_MEMORY_SHARE * share, room)
    memory = round(1e9 * options.mem_gb) or workload.shard_bytes + round(1e9 * images)
    if not options.mem_gb:
        memory = min(memory, largest.memory_bytes)
    return Allocation(at_once, TaskResources(cpus, memory if largest.memory_bytes else 0, options.gpus), images)


def allocate_queue(workload: ShardWorkload, options: ExecutorOptions) -> Allocation:
    """On machines that nobody knows before jobs start."""
    images = workload.image_gb or DEFAULT_IMAGE_GB
    memory = round(1e9 * options.mem_gb) or workload.shard_bytes + round(1e9 * images)
    return Allocation(
        workload.max_concurrent, TaskResources(options.cpus or DEFAULT_CPUS, memory, options.gpus), images
    )


def _max_cpus(at_once: int, nodes: Sequence[NodeResources]) -> int:
    """The largest number of processors with which so many shards find room at once; 1 if none do."""
    most = max(node.cpus for node in nodes)
    fitting = [cpus for cpus in range(1, most + 1) if sum(node.cpus // cpus for node in nodes) >= at_once]
    return max(fitting, default=1)
