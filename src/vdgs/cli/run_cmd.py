"""Verbs that start a run from a capture: its first stage (`train_coarse_command`), all of them (`run_command`); and the
file of settings that both take (`config_command`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from vdgs.cli.argument_parser import GivenArguments
from vdgs.cli.common import (
    QuietArguments,
    make_console,
    parse_arguments,
    read_arguments,
    set_up_compute,
)
from vdgs.cli.start_settings import StartSettings, start_settings
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import ComputeOptions, RunRequest
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import MethodConfig, TrainConfig
from vdgs.config.output_paths import Output
from vdgs.config.presets import PresetChoice
from vdgs.config.ranges import FlagName, Positional, check_ranges
from vdgs.system.quoting import shell_word

#: Options that the command in config.yaml leaves out: they belong to one start.
NOT_KEPT = ("--overwrite", "--quiet", "--dry-run")

#: The sections of settings of what comes after the coarse stage.
LATER_SECTIONS = ("partition", "assignment", "block", "merge")


@dataclass(frozen=True, kw_only=True)
class ConfigFileArguments:
    """What verbs take that begin a run."""

    config: Path | None = None
    """File of settings in YAML, as `vdgs config` writes it. Also config.yaml of another run. It wins over the preset,
    and options of the command win over it."""


@dataclass(frozen=True, kw_only=True)
class TrainCoarseArguments(ConfigFileArguments, ComputeOptions, QuietArguments):
    """Train the global anchor model of a capture. The same command continues a run that was stopped."""

    capture: Annotated[Path, Positional()]
    """Folder of the capture."""
    output: Annotated[Path, Output()]
    """Run folder; new, or the run to continue."""
    preset: PresetChoice = "auto"
    """Settings by name. `auto`: those of the run that is there, else `laptop`. `laptop`: a good result in minutes on a
    CPU. `default`: the paper's 100 000 iterations, and our choices where it is silent: gaps filled, outliers left out,
    a background of the mean color, of random colors in training, bounded sizes, only visible anchors moved. `paper`:
    the paper as printed; docs/paper.md lists what it takes where the paper is silent."""
    options: Annotated[CaptureOptions, FlagName("")] = field(default_factory=CaptureOptions)
    training: Annotated[TrainConfig, FlagName("")] = field(default_factory=TrainConfig)
    checkpointing: Annotated[CheckpointOptions, FlagName("")] = field(default_factory=CheckpointOptions)


def train_coarse_command(arguments: list[str]) -> None:
    def layer(start: StartSettings) -> dict[str, object]:
        return {"options": start.options, "training": start.method.training}

    given = read_arguments(TrainCoarseArguments, arguments, "train-coarse", lambda it: layer(start_settings(it)))
    start = start_settings(given)
    args: TrainCoarseArguments = given.over(layer(start))
    check_ranges(args)
    console, method = make_console(args.quiet), replace(start.method, training=args.training)
    if start.reason:
        console.print(f"preset: {start.reason}", highlight=False)
    device = set_up_compute(args.device, args.threads)
    from vdgs.pipeline.image_size import choose_image_size
    from vdgs.pipeline.train_coarse import train_coarse
    from vdgs.runs.config_file import changed_flags
    from vdgs.runs.create_or_resume import create_or_resume_run, run_settings
    from vdgs.runs.run_folder import RunFolder

    RunFolder(args.output).check_output_empty()
    request = RunRequest(
        capture=args.capture, output=args.output, options=args.options, threads=args.threads, device=device,
        **vars(method),
    )  # fmt: skip
    choice, command = choose_image_size(request, console), given.command_line("train-coarse", NOT_KEPT)
    context = create_or_resume_run(
        args.capture, args.output, choice.request.options, method, command=command, capture=choice.capture
    )
    asked = run_settings(args.capture, choice.request.options, method)
    if ignored := changed_flags(context.run.settings(), asked, LATER_SECTIONS):
        console.print(
            f"[yellow]note[/] the run keeps its settings of later stages ({', '.join(ignored)}): `vdgs run` changes "
            "them, or the stage that they are of (partition, train-blocks, merge)",
            highlight=False,
        )
    train_coarse(context, args.checkpointing, console, device)


@dataclass(frozen=True, kw_only=True)
class RunArguments(RunRequest, ConfigFileArguments, QuietArguments):
    """Do everything: coarse model, visibility, blocks, cameras, block training, merge, metrics, report.

    The same command continues a run that was stopped; finished stages are skipped.
    """

    dry_run: bool = False
    """Only say what it would take, and write nothing. Blocks, memory and time, by estimate and a few timed steps."""


def run_command(arguments: list[str]) -> None:
    given = read_arguments(RunArguments, arguments, "run", lambda it: start_settings(it).layer())
    start = start_settings(given)
    args: RunArguments = given.over(start.layer())
    check_ranges(args)
    console, command = make_console(args.quiet and not args.dry_run), given.command_line("run", NOT_KEPT)
    from vdgs.pipeline.finished_run import nothing_to_do

    if done := nothing_to_do(args, command):
        console.print(done, markup=False, highlight=False)
        return
    if start.reason:
        console.print(f"preset: {start.reason}", highlight=False)
    request = replace(args, device=set_up_compute(args.device, args.threads))
    if args.dry_run:
        from vdgs.pipeline.dry_run import estimate_run

        estimate_run(request, console)
        return
    from vdgs.pipeline.run_pipeline import run_pipeline

    run_pipeline(request, console, command)


@dataclass(frozen=True, kw_only=True)
class ConfigArguments(ConfigFileArguments):
    """Write all settings of a run as YAML, each with a comment, to edit and give to `--config` of run and
    train-coarse."""

    output: Annotated[Path | None, Output()] = None
    """File to write, such as settings.yaml; without it they are printed."""
    preset: PresetChoice = "auto"
    """Settings by name. `auto` takes `laptop`."""
    overwrite: bool = False
    """Replace a file that is there."""
    options: Annotated[CaptureOptions, FlagName("")] = field(default_factory=CaptureOptions)
    method: Annotated[MethodConfig, FlagName("")] = field(default_factory=MethodConfig)


def config_command(arguments: list[str]) -> None:
    def layer(given: GivenArguments) -> dict[str, object]:
        start = start_settings(given)
        return {"options": start.options, "method": start.method}

    args = parse_arguments(ConfigArguments, arguments, "config", layer)
    from vdgs.runs.settings_file import write_settings_file

    text = write_settings_file(args.output, args.options, args.method, args.overwrite)
    if args.output is None:
        print(text, end="")
    else:
        print(f"{args.output}: written. Next: vdgs run CAPTURE --output RUN --config {shell_word(args.output)}")
