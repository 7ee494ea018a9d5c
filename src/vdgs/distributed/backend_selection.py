"""The executor that a person asked for, made ready: connected, its machines asked whether they can work on the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from vdgs.config.executor_options import ExecutorOptions
from vdgs.distributed.executor import Executor
from vdgs.distributed.local_executor import LocalExecutor
from vdgs.distributed.node_check import Question
from vdgs.distributed.resource_allocation import Share, Work, by_queue, exceeds, on_cluster, on_this_machine
from vdgs.system.units import data_size

#: Seconds to wait for what still holds a shard: NFS lets go of what a lost node held after a minute and a half.
PATIENCE_SECONDS = 300.0


@dataclass(frozen=True)
class Chosen:
    """What runs shards, and what each gets."""

    executor: Executor
    share: Share
    line: str
    """Where they run and with what, in words."""
    notes: tuple[str, ...] = ()
    """What a person should know before it begins."""


@dataclass(frozen=True)
class Machine:
    """What this machine has."""

    cores: int
    free_bytes: int


@contextmanager
def choose(asked: ExecutorOptions, work: Work, machine: Machine, question: Callable[[], Question]) -> Iterator[Chosen]:
    """Be ready to run shards while the context lasts. `question` says what machines must see; asked of other
    machines only.

    Raises VdgsError, before anything starts, for options that do not work, where there is no such cluster, and where a
    machine cannot work on the run.
    """
    asked.check()
    if asked.executor == "ray":
        from vdgs.distributed.ray_executor import connected

        with connected(asked.address):
            yield _ray(asked, work, question())
    elif asked.executor == "slurm":
        yield _slurm(asked, work, question())
    else:
        yield _local(work, machine)


def refuse_unreachable(asked: ExecutorOptions) -> None:
    """Say before long work what would otherwise come out after it. Raises VdgsError where what was asked for is not
    there: Ray, a cluster at its address, the commands of SLURM."""
    asked.check()
    if asked.executor == "ray":
        from vdgs.distributed import ray_executor

        ray_executor.refuse_unreachable(asked.address)
    elif asked.executor == "slurm":
        from vdgs.distributed.slurm_executor import refuse_without_slurm

        refuse_without_slurm()


def _local(work: Work, machine: Machine) -> Chosen:
    share = on_this_machine(work, machine.cores, machine.free_bytes)
    photographs = min(work.photographs_bytes, round(1e9 * share.image_gb))
    beside = f" and {data_size(photographs)} for photographs" if photographs else ""
    line = (
        f"{share.at_once} at once with {share.needs.processors} thread(s) each; by estimate a {work.kind.one} takes "
        f"at most {data_size(work.piece_bytes)}{beside}, of {data_size(machine.free_bytes)} free"
    )
    note = (
        f"[yellow]warning[/] {share.at_once} at once may run out of memory. What helps: "
        f"{', '.join(('less --jobs', *work.kind.smaller))}"
    )
    short = exceeds(work, share.at_once, machine.free_bytes)
    return Chosen(LocalExecutor(share.at_once), share, line, (note,) if short else ())


def _ray(asked: ExecutorOptions, work: Work, question: Question) -> Chosen:
    from vdgs.distributed.ray_executor import RayExecutor, ask_nodes, nodes
    from vdgs.errors import VdgsError

    answers = ask_nodes(question, nodes())
    there = nodes()  # one that died just before was still listed when it was asked
    if not there:
        raise VdgsError("The Ray cluster has no node with processors. See `ray status`.")
    share = on_cluster(work, there, asked)
    notes, needs = [], share.needs
    if not any(
        node.processors >= needs.processors and node.memory_bytes >= needs.memory_bytes and node.gpus >= needs.gpus
        for node in there
    ):
        notes.append(f"[yellow]note[/] no node has {_needs(share)} now: {work.kind.many} wait until one joins that has")
    if needs.memory_bytes and needs.memory_bytes < work.piece_bytes:
        notes.append(
            f"[yellow]warning[/] by estimate a {work.kind.one} takes at most {data_size(work.piece_bytes)}, more than "
            "any node has." + (f" What helps: {', '.join(work.kind.smaller)}" if work.kind.smaller else "")
        )
    processors = sorted({answer["processor"] for answer in answers})
    if len(processors) > 1:
        notes.append(
            f"[yellow]note[/] nodes have different processors ({', '.join(processors)}): what they compute differs in "
            "its last bits. With VDGS_ISA=avx2 (or portable) all compute alike"
        )
    names = len(there), sum(node.processors for node in there)
    line = f"over {names[0]} node{'s' if names[0] > 1 else ''} of Ray with {names[1]} processors, {_needs(share)} each"
    executor = RayExecutor(share.at_once, patience_seconds=PATIENCE_SECONDS, question=question)
    return Chosen(executor, share, line, tuple(notes))


def _slurm(asked: ExecutorOptions, work: Work, question: Question) -> Chosen:
    from vdgs.distributed.slurm_executor import SlurmExecutor, refuse_without_slurm

    refuse_without_slurm()
    share = by_queue(work, asked)
    options = asked.slurm
    executor = SlurmExecutor(
        at_once=share.at_once, poll_seconds=options.poll_seconds, patience_seconds=PATIENCE_SECONDS, question=question,
        options=options,
    )  # fmt: skip
    return Chosen(executor, share, f"as jobs of SLURM, {_needs(share)} each")


def _needs(share: Share) -> str:
    needs = share.needs
    parts = [f"{needs.processors} processor{'s' if needs.processors > 1 else ''}"]
    if needs.memory_bytes:
        parts.append(data_size(needs.memory_bytes))
    if needs.gpus:
        parts.append(f"{needs.gpus:g} GPU")
    return ", ".join(parts)
