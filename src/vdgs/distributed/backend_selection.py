"""The executor that was requested, made ready: connected, its machines asked whether they can work on the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from vdgs.config.executor_options import ExecutorOptions
from vdgs.distributed.executor import Executor
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.distributed.node_check import NodeRequirements
from vdgs.distributed.resource_allocation import (
    Allocation,
    MachineResources,
    ShardWorkload,
    allocate_cluster,
    allocate_local,
    allocate_queue,
    exceeds_memory,
)
from vdgs.errors import VdgsError
from vdgs.system.units import data_size

#: Seconds to wait for what still holds a shard: NFS keeps the locks of a lost node for a minute and a half.
LOCK_TIMEOUT_SECONDS = 300.0


@dataclass(frozen=True)
class SelectedBackend:
    """What runs shards, and what each gets."""

    executor: Executor
    allocation: Allocation
    description: str
    """Where they run and with what, in words."""
    notes: tuple[str, ...] = ()
    """What a person should know before it begins."""


@contextmanager
def select_backend(
    options: ExecutorOptions,
    workload: ShardWorkload,
    machine: MachineResources,
    requirements: Callable[[], NodeRequirements],
) -> Iterator[SelectedBackend]:
    """A backend that is ready while the context lasts. `requirements` are asked for where other machines do the work.

    Raises VdgsError, before anything starts, for options that do not work, where there is no such cluster, and where a
    machine cannot work on the run.
    """
    options.check()
    if options.executor == "ray":
        from vdgs.distributed.ray_executor import connect

        with connect(options.address):
            yield _ray(options, workload, requirements())
    elif options.executor == "slurm":
        yield _slurm(options, workload, requirements())
    else:
        yield _local(workload, machine)


def check_backend_reachable(options: ExecutorOptions) -> None:
    """Raise VdgsError, before long work, where the requested executor is not there: Ray, a cluster at its address, the
    commands of SLURM."""
    options.check()
    if options.executor == "ray":
        from vdgs.distributed import ray_executor

        ray_executor.check_reachable(options.address)
    elif options.executor == "slurm":
        from vdgs.distributed.slurm_commands import require_slurm

        require_slurm()


def _local(workload: ShardWorkload, machine: MachineResources) -> SelectedBackend:
    allocation = allocate_local(workload, machine)
    at_once, kind = allocation.max_concurrent, workload.kind
    images = min(workload.images_bytes, round(1e9 * allocation.image_gb))
    images_text = f" and {data_size(images)} for photographs" if images else ""
    text = (
        f"{at_once} at once{_on_cards(machine)} with {allocation.resources.cpus} thread(s) each; by estimate a "
        f"{kind.singular} takes at most {data_size(workload.shard_bytes)}{images_text}, of "
        f"{data_size(machine.free_bytes)} free"
    )
    notes: tuple[str, ...] = ()
    if exceeds_memory(workload, at_once, machine.free_bytes):
        remedies = ", ".join(("less --jobs", *kind.memory_saving_options))
        notes = (f"[yellow]warning[/] {at_once} at once may run out of memory. What helps: {remedies}",)
    executor = LocalExecutor(at_once, max_per_device=-(-at_once // max(1, len(machine.cards))))
    return SelectedBackend(executor, allocation, text, notes)


def _on_cards(machine: MachineResources) -> str:
    count = len(machine.cards)
    return "" if not count else " on one card" if count == 1 else f" on {count} cards"


def _ray(options: ExecutorOptions, workload: ShardWorkload, requirements: NodeRequirements) -> SelectedBackend:
    from vdgs.distributed.ray_executor import RayExecutor, check_nodes, list_nodes

    answers = check_nodes(requirements, list_nodes())
    nodes = list_nodes()  # one that died just before was still listed when it was asked
    if not nodes:
        raise VdgsError("The Ray cluster has no node with processors. See `ray status`.")
    allocation, kind = allocate_cluster(workload, nodes, options), workload.kind
    notes, needs, each = [], allocation.resources, _resources_text(allocation)
    if not any(
        node.cpus >= needs.cpus and node.memory_bytes >= needs.memory_bytes and node.gpus >= needs.gpus
        for node in nodes
    ):
        notes.append(f"[yellow]note[/] no node has {each} now: {kind.plural} wait until one joins that has")
    if needs.memory_bytes and needs.memory_bytes < workload.shard_bytes:
        helps = f" What helps: {', '.join(kind.memory_saving_options)}" if kind.memory_saving_options else ""
        notes.append(
            f"[yellow]warning[/] by estimate a {kind.singular} takes at most {data_size(workload.shard_bytes)}, more "
            f"than any node has.{helps}"
        )
    processors = sorted({answer["processor"] for answer in answers})
    if len(processors) > 1:
        notes.append(
            f"[yellow]note[/] nodes have different processors ({', '.join(processors)}): what they compute differs in "
            "its last bits. With VDGS_ISA=avx2 (or portable) all compute alike"
        )
    cpus = sum(node.cpus for node in nodes)
    text = f"over {len(nodes)} node{'s' if len(nodes) > 1 else ''} of Ray with {cpus} processors, {each} each"
    executor = RayExecutor(
        allocation.max_concurrent, lock_timeout_seconds=LOCK_TIMEOUT_SECONDS, requirements=requirements
    )
    return SelectedBackend(executor, allocation, text, tuple(notes))


def _slurm(options: ExecutorOptions, workload: ShardWorkload, requirements: NodeRequirements) -> SelectedBackend:
    from vdgs.distributed.slurm_commands import require_slurm
    from vdgs.distributed.slurm_executor import SlurmExecutor

    require_slurm()
    allocation = allocate_queue(workload, options)
    executor = SlurmExecutor(
        max_concurrent=allocation.max_concurrent,
        poll_seconds=options.slurm.poll_seconds,
        lock_timeout_seconds=LOCK_TIMEOUT_SECONDS,
        requirements=requirements,
        options=options.slurm,
    )
    return SelectedBackend(executor, allocation, f"as jobs of SLURM, {_resources_text(allocation)} each")


def _resources_text(allocation: Allocation) -> str:
    needs = allocation.resources
    parts = [f"{needs.cpus} processor{'s' if needs.cpus > 1 else ''}"]
    if needs.memory_bytes:
        parts.append(data_size(needs.memory_bytes))
    if needs.gpus:
        parts.append(f"{needs.gpus:g} GPU")
    return ", ".join(parts)
