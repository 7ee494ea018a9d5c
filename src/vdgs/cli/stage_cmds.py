"""Verbs that take a run one stage further: `visibility`, `partition`, `train-blocks`, `merge`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from vdgs.cli.common import (
    ShardArguments,
    StageArguments,
    make_console,
    parse_arguments,
    parse_for_run,
    set_up_compute,
    update_run_settings,
)
from vdgs.config.commands import ComputeOptions, LodRequest
from vdgs.config.executor_options import CheckpointOptions, ExecutorOptions
from vdgs.config.method import AssignmentConfig, BlockConfig, MergeConfig, PartitionConfig
from vdgs.config.ranges import WORKER_COUNT, FlagName, Range


@dataclass(frozen=True, kw_only=True)
class VisibilityArguments(StageArguments):
    """Count how many training cameras see each part of a run's scene; writes a map and the distribution.

    Before, what moves between the photographs is looked for, and masked for the blocks (--block.mask-moving).
    """


def visibility_command(arguments: list[str]) -> None:
    args = parse_arguments(VisibilityArguments, arguments, "visibility")
    from vdgs.pipeline.count_visibility import count_run_visibility
    from vdgs.pipeline.find_motion import find_run_motion
    from vdgs.runs.run_context import RunContext

    context, console = RunContext.from_path(args.run, args.capture), make_console(args.quiet)
    find_run_motion(context, console)
    count_run_visibility(context, console)


@dataclass(frozen=True, kw_only=True)
class PartitionArguments(ShardArguments, ComputeOptions, StageArguments):
    """Cut a run's scene into blocks by place and visibility, and give each block its cameras.

    Before, what `vdgs visibility` finds is found where that was not run.
    """

    overwrite: bool = False
    """Allow another cut to discard blocks that are trained."""
    explain: str | None = None
    """Name of a training photograph: also say how well it shows each block and why it was assigned or not."""
    partition: Annotated[PartitionConfig, FlagName("")] = field(default_factory=PartitionConfig)
    assignment: AssignmentConfig = field(default_factory=AssignmentConfig)


def partition_command(arguments: list[str]) -> None:
    args, run, method = parse_for_run(
        PartitionArguments, arguments, "partition",
        lambda own: {"partition": own.partition, "assignment": own.assignment},
    )  # fmt: skip
    from vdgs.pipeline.count_visibility import count_run_visibility, is_visibility_counted
    from vdgs.pipeline.find_motion import find_run_motion
    from vdgs.pipeline.partition_stage import explain_view, is_cut, partition_run
    from vdgs.runs.motion_masks import has_motion_record
    from vdgs.runs.run_context import RunContext

    device, console = set_up_compute(args.device, args.threads), make_console(args.quiet)
    execution, context = args.execution(device), RunContext.from_path(args.run, args.capture)
    method = replace(method, partition=args.partition, assignment=args.assignment)
    update_run_settings(run, method, args.overwrite, console)
    if not is_cut(run):  # a look at the cut of a trained run changes nothing
        if not has_motion_record(run):
            find_run_motion(context, console, device)
        if not is_visibility_counted(run):
            count_run_visibility(context, console)
    partition_run(context, console, device, execution)
    if args.explain is not None:
        explain_view(run, args.explain, console)


@dataclass(frozen=True, kw_only=True)
class TrainBlocksArguments(ComputeOptions, StageArguments):
    """Train the blocks of a run. The same command continues; blocks may also be trained on several machines."""

    block: Annotated[int | None, Range(0, 10_000)] = None
    """Only this block, in this process; without it all of them, several at once."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Blocks trained at once; 0 takes what cores and memory allow."""
    overwrite: bool = False
    """Let other settings discard blocks trained with the old ones."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads of the kernels for --block; 0 for all cores. The result does not depend on it."""
    block_config: Annotated[BlockConfig, FlagName("block")] = field(default_factory=BlockConfig)
    checkpointing: Annotated[CheckpointOptions, FlagName("")] = field(default_factory=CheckpointOptions)
    executor_options: Annotated[ExecutorOptions, FlagName("")] = field(default_factory=ExecutorOptions)


def train_blocks_command(arguments: list[str]) -> None:
    args, run, method = parse_for_run(
        TrainBlocksArguments, arguments, "train-blocks",
        lambda own: {"block_config": own.block},
    )  # fmt: skip
    from vdgs.distributed.backend_selection import check_backend_reachable
    from vdgs.pipeline.train_block import train_block
    from vdgs.pipeline.train_blocks import train_blocks
    from vdgs.runs.run_context import RunContext

    if args.block is None:
        check_backend_reachable(args.executor_options)
    device = set_up_compute(args.device, 0 if args.block is None else args.threads)
    context, console = RunContext.from_path(args.run, args.capture), make_console(args.quiet)
    update_run_settings(run, replace(method, block=args.block_config), args.overwrite, console)
    if args.block is not None:
        train_block(context, args.block, args.checkpointing, console, device)
    else:
        train_blocks(context, args.checkpointing, args.jobs, console, device, args.executor_options)


@dataclass(frozen=True, kw_only=True)
class MergeArguments(StageArguments):
    """Merge the trained blocks of a run into one scene."""

    allow_missing_blocks: bool = False
    """Let the coarse model stand in for blocks that are missing or failed."""
    merge: Annotated[MergeConfig, FlagName("")] = field(default_factory=MergeConfig)


def merge_command(arguments: list[str]) -> None:
    args, run, method = parse_for_run(MergeArguments, arguments, "merge", lambda own: {"merge": own.merge})
    from vdgs.pipeline.merge_blocks import merge_run_blocks
    from vdgs.runs.run_context import RunContext

    context, console = RunContext.from_path(args.run, args.capture), make_console(args.quiet)
    update_run_settings(run, replace(method, merge=args.merge), False, console)
    merge_run_blocks(context, args.allow_missing_blocks, console)


@dataclass(frozen=True, kw_only=True)
class LodArguments(LodRequest, StageArguments):
    """Make a level-of-detail tree of a run's scene, so that views of any size are drawn in bounded time and memory.

    `vdgs view` uses it by itself; `vdgs render`, `ortho` and `eval` with --lod-error. The same command continues.
    """

    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads; 0 for all cores. The result does not depend on it."""


def lod_command(arguments: list[str]) -> None:
    args = parse_arguments(LodArguments, arguments, "lod")
    from vdgs.pipeline.build_lod import build_lod
    from vdgs.runs.run_context import RunContext

    set_up_compute("cpu", args.threads)
    build_lod(RunContext.from_path(args.run, args.capture), args, make_console(args.quiet))
