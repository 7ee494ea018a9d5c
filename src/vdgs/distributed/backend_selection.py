"""The executor that a person asked for, made ready: connected, its machines asked whether they can work on the run."""

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
    ShardWorkload,
    allocate_cluster,
    allocate_local,
    allocate_queue,
    exceeds_memory,
)
from vdgs.system.units import data_size

#: Seconds to wait for what still holds a shard: NFS lets go of what a lost node held after a minute and a half.
LOCK_TIMEOUT_SECONDS = 300.0


@dataclass(frozen=True)
class SelectedBackend:
    """What runs shards, and what each gets."""

    executor: Executor
    share: Allocation
    description: str
    """Where they run and with what, in words."""
    notes: tuple[str, ...] = ()
    """What a person should know before it begins."""


@dataclass(frozen=True)
class MachineResources:
    """What this machine has."""

    cores: int
    free_bytes: int


@contextmanager
def select_backend(
    executor_options: ExecutorOptions,
    workload: ShardWorkload,
    machine: MachineResources,
    requirements: Callable[[], NodeRequirements],
) -> Iterator[SelectedBackend]:
    """Be ready to run shards while the context lasts. `question` says what machines must see; asked of other
    machines only.

    Raises VdgsError, before anything starts, for options that do not work, where there is no such cluster, and where a
    machine cannot work on the run.
    """
    executor_options.check()
    if executor_options.executor == "ray":
        from vdgs.distributed.ray_executor import connect

        with connect(executor_options.address):
            yield _ray(executor_options, workload, requirements())
    elif executor_options.executor == "slurm":
        yield _slurm(executor_options, workload, requirements())
    else:
        yield _local(workload, machine)


def check_backend_reachable(executor_options: ExecutorOptions) -> None:
    """Say before long work what would otherwise come out after it. Raises VdgsError where what was asked for is not
    there: Ray, a cluster at its address, the commands of SLURM."""
    executor_options.check()
    if executor_options.executor == "ray":
        from vdgs.distributed import ray_executor

        ray_executor.check_reachable(executor_options.address)
    elif executor_options.executor == "slurm":
        from vdgs.distributed.slurm_executor import require_slurm

        require_slurm()


def _local(workload: ShardWorkload, machine: MachineResources) -> SelectedBackend:
    share = allocate_local(workload, machine.cores, machine.free_bytes)
    photographs = min(workload.images_bytes, round(1e9 * share.image_gb))
    beside = f" and {data_size(photographs)} for photographs" if photographs else ""
    line = (
        f"{share.max_concurrent} at once with {share.resources.cpus} thread(s) each; by estimate a {workload.kind.singular} takes "
        f"at most {data_size(workload.shard_bytes)}{beside}, of {data_size(machine.free_bytes)} free"
    )
    note = (
        f"[yellow]warning[/] {share.max_concurrent} at once may run out of memory. What helps: "
        f"{', '.join(('less --jobs', *workload.kind.memory_saving_options))}"
    )
    short = exceeds_memory(workload, share.max_concurrent, machine.free_bytes)
    return SelectedBackend(LocalExecutor(share.max_concurrent), share, line, (note,) if short else ())


def _ray(executor_options: ExecutorOptions, workload: ShardWorkload, requirements: NodeRequirements) -> SelectedBackend:
    from vdgs.distributed.ray_executor import RayExecutor, check_nodes, list_nodes
    from vdgs.errors import VdgsError

    answers = check_nodes(requirements, list_nodes())
    there = list_nodes()  # one that died just before was still listed when it was asked
    if not there:
        raise VdgsError("The Ray cluster has no node with processors. See `ray status`.")
    share = allocate_cluster(workload, there, executor_options)
    notes, needs = [], share.resources
    if not any(
        node.cpus >= needs.cpus and node.memory_bytes >= needs.memory_bytes and node.gpus >= needs.gpus
        for node in there
    ):
        notes.append(
            f"[yellow]note[/] no node has {_resources_text(share)} now: {workload.kind.plural} wait until one joins that has"
        )
    if needs.memory_bytes and needs.memory_bytes < workload.shard_bytes:
        notes.append(
            f"[yellow]warning[/] by estimate a {workload.kind.singular} takes at most {data_size(workload.shard_bytes)}, more than "
            "any node has."
            + (
                f" What helps: {', '.join(workload.kind.memory_saving_options)}"
                if workload.kind.memory_saving_options
                else ""
            )
        )
    processors = sorted({answer["processor"] for answer in answers})
    if len(processors) > 1:
        notes.append(
            f"[yellow]note[/] nodes have different processors ({', '.join(processors)}): what they compute differs in "
            "its last bits. With VDGS_ISA=avx2 (or portable) all compute alike"
        )
    names = len(there), sum(node.cpus for node in there)
    line = f"over {names[0]} node{'s' if names[0] > 1 else ''} of Ray with {names[1]} processors, {_resources_text(share)} each"
    executor = RayExecutor(share.max_concurrent, lock_timeout_seconds=LOCK_TIMEOUT_SECONDS, requirements=requirements)
    return SelectedBackend(executor, share, line, tuple(notes))


def _slurm(
    executor_options: ExecutorOptions, workload: ShardWorkload, requirements: NodeRequirements
) -> SelectedBackend:
    from vdgs.distributed.slurm_executor import SlurmExecutor, require_slurm

    require_slurm()
    share = allocate_queue(workload, executor_options)
    options = executor_options.slurm
    executor = SlurmExecutor(
        max_concurrent=share.max_concurrent,
        poll_seconds=options.poll_seconds,
        lock_timeout_seconds=LOCK_TIMEOUT_SECONDS,
        requirements=requirements,
        options=options,
    )
    return SelectedBackend(executor, share, f"as jobs of SLURM, {_resources_text(share)} each")


def _resources_text(allocation: Allocation) -> str:
    needs = allocation.resources
    parts = [f"{needs.cpus} processor{'s' if needs.cpus > 1 else ''}"]
    if needs.memory_bytes:
        parts.append(data_size(needs.memory_bytes))
    if needs.gpus:
        parts.append(f"{needs.gpus:g} GPU")
    return ", ".join(parts)
