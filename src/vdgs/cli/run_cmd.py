"""Verbs that start a run from a capture: its first stage (`train_coarse_command`), all of them (`run_command`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional, arg

from vdgs.cli.common import (
    ComputeArguments,
    QuietArguments,
    absolute_command_line,
    make_console,
    parse_arguments,
    preset_defaults,
    set_up_compute,
)
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import RunRequest
from vdgs.config.executor_options import CheckpointOptions, ExecutorOptions
from vdgs.config.method import PartitionConfig, TrainConfig
from vdgs.config.output_paths import Output
from vdgs.config.presets import PresetName


@dataclass(frozen=True, kw_only=True)
class TrainCoarseArguments(ComputeArguments):
    """Train the global anchor model of a capture. The same command continues a run that was stopped."""

    capture: Positional[Path]
    """Folder of the capture."""
    output: Annotated[Path, Output()]
    """Run folder; new, or the run to continue."""
    preset: PresetName = "default"
    """`laptop`: a good result in minutes on a CPU. `default`: the paper's 100 000 iterations, and our choices where it
    is silent: gaps filled, outliers left out, a background of the mean color, of random colors in training, bounded
    sizes, only visible anchors moved. `paper`: none of those choices."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)
    training: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    checkpointing: Annotated[CheckpointOptions, arg(name="")] = field(default_factory=CheckpointOptions)


def train_coarse_command(arguments: list[str]) -> None:
    preset, settings = preset_defaults(arguments)
    default = TrainCoarseArguments(capture=tyro.MISSING, output=tyro.MISSING, preset=preset, training=settings.training)
    args = parse_arguments(TrainCoarseArguments, arguments, "vdgs train-coarse", default)
    from vdgs.pipeline.train_coarse import train_coarse
    from vdgs.runs.create_or_resume import create_or_resume_run

    device = set_up_compute(args.device, args.threads)
    method = replace(settings, training=args.training)
    command = absolute_command_line("train-coarse", arguments, (args.capture, args.output))
    context = create_or_resume_run(args.capture, args.output, args.options, method, command=command)
    train_coarse(context, args.checkpointing, make_console(args.quiet), device)


@dataclass(frozen=True, kw_only=True)
class RunArguments(RunRequest, QuietArguments):
    """Do everything: coarse model, visibility, blocks, cameras, block training, merge, metrics, report.

    The same command continues a run that was stopped; finished stages are skipped.
    """

    capture: Positional[Path]
    """Folder of the capture, or of photographs alone: they become one in RUN/capture first (`vdgs sfm`)."""
    images: Positional[tuple[Path, ...]] = ()
    """More folders of photographs, where the first is one of photographs alone."""
    dry_run: bool = False
    """Only say what it would take: blocks, memory, time, by estimate and a few steps that are timed. Writes nothing."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)
    training: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    partition: Annotated[PartitionConfig, arg(name="")] = field(default_factory=PartitionConfig)
    checkpointing: Annotated[CheckpointOptions, arg(name="")] = field(default_factory=CheckpointOptions)
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)


def run_command(arguments: list[str]) -> None:
    preset, settings = preset_defaults(arguments)
    default = RunArguments(
        capture=tyro.MISSING, output=tyro.MISSING, preset=preset, training=settings.training,
        partition=settings.partition, assignment=settings.assignment, block=settings.block, merge=settings.merge,
    )  # fmt: skip
    args = parse_arguments(RunArguments, arguments, "vdgs run", default)
    request = replace(args, device=set_up_compute(args.device, args.threads))
    if args.dry_run:
        from vdgs.pipeline.dry_run import estimate_run

        estimate_run(request, make_console())
        return
    from vdgs.pipeline.run_pipeline import run_pipeline

    command = absolute_command_line("run", arguments, (args.capture, *args.images, args.output))
    run_pipeline(request, make_console(args.quiet), command)
