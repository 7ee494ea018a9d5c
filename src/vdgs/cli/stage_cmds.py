"""Verbs that take a run one stage further: `visibility_command`, `partition_command`, `train_blocks_command`, `merge_command`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from vdgs.cli.common import (
    make_console,
    parse_arguments,
    parse_for_run,
    select_device,
    update_run_settings,
)
from vdgs.config.executor_options import CheckpointOptions, ExecutorOptions
from vdgs.config.method import AssignmentConfig, BlockConfig, MergeConfig, MethodConfig, PartitionConfig
from vdgs.config.ranges import WORKER_COUNT, Range
from vdgs.kernels import configure_threads


@dataclass(frozen=True)
class VisibilityArguments:
    """Count how many training cameras see each part of a run's scene; writes a map and the distribution."""

    run: Positional[Path]
    """Run folder with a coarse model."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""


def visibility_command(arguments: list[str]) -> None:
    asked = parse_arguments(VisibilityArguments, arguments, "vdgs visibility")
    from vdgs.pipeline.count_visibility import count_run_visibility
    from vdgs.runs.run_context import RunContext

    count_run_visibility(RunContext.from_path(asked.run, asked.capture), make_console(asked.quiet))


@dataclass(frozen=True, kw_only=True)
class PartitionArguments:
    """Cut a run's scene into blocks by place and visibility, and give each block its cameras."""

    run: Positional[Path]
    """Run folder with a coarse model."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    overwrite: bool = False
    """Allow another cut to discard blocks that are trained."""
    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""
    explain: str | None = None
    """Name of a training photograph: also say how well it shows each block and why it was assigned or not."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Shards of the cameras scored at once, each in a process of its own; 0: on this machine one process scores all, a
    cluster as many as it has room for."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    device: str = "auto"
    """Where to draw what cameras see: auto, cpu, cuda or cuda:0. `auto` takes a GPU only if every operation runs on
    it."""
    partition: Annotated[PartitionConfig, arg(name="")] = field(default_factory=PartitionConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)


def partition_command(arguments: list[str]) -> None:
    def defaults(method: MethodConfig) -> PartitionArguments:
        return PartitionArguments(run=tyro.MISSING, partition=method.partition, assignment=method.assignment)

    asked, run, method = parse_for_run(PartitionArguments, arguments, "vdgs partition", defaults)
    from vdgs.distributed.sharded_job import ExecutionOptions
    from vdgs.pipeline.partition_stage import explain_view, partition_run
    from vdgs.runs.run_context import RunContext

    device = select_device(asked.device)
    configure_threads(asked.threads)
    asked.executor_options.check()
    context = RunContext.from_path(asked.run, asked.capture)
    update_run_settings(
        run, replace(method, partition=asked.partition, assignment=asked.assignment), asked.overwrite, asked.quiet
    )
    partition_run(
        context, make_console(asked.quiet), device, ExecutionOptions(asked.executor_options, asked.jobs, device=device)
    )
    if asked.explain is not None:
        explain_view(run, asked.explain, make_console(asked.quiet))


@dataclass(frozen=True, kw_only=True)
class TrainBlocksArguments:
    """Train the blocks of a run. The same command continues; blocks may also be trained on several machines."""

    run: Positional[Path]
    """Run folder that is cut into blocks."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    block: Annotated[int | None, Range(0, 10_000)] = None
    """Only this block, in this process; without it all of them, several at once."""
    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Blocks trained at once; 0 takes what cores and memory allow."""
    overwrite: bool = False
    """Allow other settings to discard blocks that are trained with the old ones."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels for --block; 0 for all cores. The result does not depend on it."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda or cuda:0. `auto` takes a GPU only if every operation runs on it."""
    block_config: Annotated[BlockConfig, arg(name="block")] = field(default_factory=BlockConfig)
    checkpointing: Annotated[CheckpointOptions, arg(name="")] = field(default_factory=CheckpointOptions)
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)


def train_blocks_command(arguments: list[str]) -> None:
    def defaults(method: MethodConfig) -> TrainBlocksArguments:
        return TrainBlocksArguments(run=tyro.MISSING, block_config=method.block)

    asked, run, method = parse_for_run(TrainBlocksArguments, arguments, "vdgs train-blocks", defaults)
    device = select_device(asked.device)
    from vdgs.runs.run_context import RunContext

    context = RunContext.from_path(asked.run, asked.capture)
    update_run_settings(run, replace(method, block=asked.block_config), asked.overwrite, asked.quiet)
    if asked.block is not None:
        from vdgs.pipeline.train_block import train_block

        configure_threads(asked.threads)
        train_block(context, asked.block, asked.checkpointing, make_console(asked.quiet), device)
    else:
        from vdgs.pipeline.train_blocks import train_blocks

        train_blocks(
            context, asked.checkpointing, asked.jobs, make_console(asked.quiet), device, asked.executor_options
        )


@dataclass(frozen=True)
class MergeArguments:
    """Merge the trained blocks of a run into one scene."""

    run: Positional[Path]
    """Run folder whose blocks are trained."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    capture: Path | None = None
    """Where the capture lies now, if it was moved; the run remembers it."""
    allow_missing_blocks: bool = False
    """Let the coarse model stand in for blocks that are missing or failed."""
    merge: Annotated[MergeConfig, arg(name="")] = field(default_factory=MergeConfig)


def merge_command(arguments: list[str]) -> None:
    def defaults(method: MethodConfig) -> MergeArguments:
        return MergeArguments(tyro.MISSING, merge=method.merge)

    asked, run, method = parse_for_run(MergeArguments, arguments, "vdgs merge", defaults)
    from vdgs.pipeline.merge_blocks import merge_run_blocks
    from vdgs.runs.run_context import RunContext

    context = RunContext.from_path(asked.run, asked.capture)
    update_run_settings(run, replace(method, merge=asked.merge), overwrite=False, quiet=asked.quiet)
    merge_run_blocks(context, asked.allow_missing_blocks, make_console(asked.quiet))
