"""The verbs of the command line: options as dataclasses, each handed to the room that does the work.

Nothing heavy is imported before the options are parsed, so that help and usage errors come at once.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from vdgs.captures.options import CaptureOptions
from vdgs.config import PRESETS, PresetName, TrainConfig
from vdgs.run_options import CoarseOptions
from vdgs.synth.options import SynthOptions

# torch's OpenMP threads must block, not spin, beside the kernels' own pool; read once, when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@dataclass(frozen=True)
class InspectArguments:
    """Say what a capture holds and how well its photographs cover the place, in a table and figures."""

    capture: Positional[Path]
    """Folder of the capture."""
    output: Path
    """Folder for report.json and the figures."""
    check: bool = True
    """Decode every photograph once, to find damaged ones."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)


@dataclass(frozen=True)
class CoarseArguments:
    """Train the global anchor model of a capture. The same command continues a run that was stopped."""

    capture: Positional[Path]
    """Folder of the capture."""
    output: Path
    """Run folder; new, or the run to continue."""
    preset: PresetName = "paper"
    """`paper`: the paper's settings (100 000 iterations). `laptop`: a good result in minutes on a CPU."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores. The result does not depend on it."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)
    training: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)
    watching: Annotated[CoarseOptions, arg(name="")] = field(default_factory=CoarseOptions)


@dataclass(frozen=True)
class EvalArguments:
    """Render the test views of a run and measure them: metrics.json, per_view.json, pictures, a table."""

    run: Positional[Path]
    """Run folder."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    bins: int = 4
    """Number of visibility quantiles by which metrics are reported."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores."""


@dataclass(frozen=True)
class RenderArguments:
    """Render a run: its test views, its training views, or a camera path; as PNG files or a video."""

    run: Positional[Path]
    """Run folder."""
    output: Path
    """Folder for PNG files, or a file that ends in .mp4."""
    views: Literal["test", "train", "orbit", "flyover"] = "test"
    """Which cameras; `orbit` and `flyover` are paths made from the capture."""
    path: Path | None = None
    """JSON file with a camera path (docs/conventions.md); overrides --views."""
    seconds: float = 0.0
    """Length of a camera path; 0: what its file says, or 12 seconds."""
    fps: float = 0.0
    """Frames per second of a camera path and of the video; 0: what its file says, or 30 (2 for separate views)."""
    width: int = 0
    """Image width; 0 takes that of the training views."""
    kind: Literal["image", "depth", "visibility"] = "image"
    """What to draw: the picture, expected depth, or the number of cameras that see each place."""
    threads: int = 0
    """Threads of the kernels; 0 for all cores."""


@dataclass(frozen=True)
class SynthArguments:
    """Generate a small aerial town seen by an uneven drone flight, as a COLMAP capture."""

    output: Positional[Path]
    """Folder for the capture; it must not exist or be empty."""
    options: Annotated[SynthOptions, arg(name="")] = field(default_factory=SynthOptions)


@dataclass(frozen=True)
class DoctorArguments:
    """Say what this machine can use, and what to install for the rest."""

    json: bool = False
    """Print JSON instead of a table."""


def inspect(arguments: list[str]) -> None:
    asked = tyro.cli(InspectArguments, args=arguments, prog="vdgs inspect")
    from vdgs.captures.checks import check_images
    from vdgs.captures.loading import load_capture
    from vdgs.inspect import inspect_capture, print_report

    capture = load_capture(asked.capture, asked.options)
    if asked.check:
        check_images(capture)
    print_report(inspect_capture(capture, asked.output))


def coarse(arguments: list[str]) -> None:
    preset = _preset(arguments)
    default = CoarseArguments(tyro.MISSING, tyro.MISSING, preset, training=PRESETS[preset])
    asked = tyro.cli(CoarseArguments, args=arguments, prog="vdgs coarse", default=default)
    from vdgs.coarse import train_coarse

    _use_threads(asked.threads)
    train_coarse(asked.capture, asked.output, asked.options, asked.training, asked.watching, _console())


def eval(arguments: list[str]) -> None:
    asked = tyro.cli(EvalArguments, args=arguments, prog="vdgs eval")
    from vdgs.evaluation.of_run import evaluate_run

    _use_threads(asked.threads)
    evaluate_run(asked.run, asked.lpips_weights, asked.bins, _console())


def render(arguments: list[str]) -> None:
    asked = tyro.cli(RenderArguments, args=arguments, prog="vdgs render")
    from vdgs.render_run import render_run

    _use_threads(asked.threads)
    render_run(asked, _console())


def synth(arguments: list[str]) -> None:
    asked = tyro.cli(SynthArguments, args=arguments, prog="vdgs synth")
    from rich.progress import Progress, TaskID

    from vdgs.synth import generate

    console = _console()
    with Progress(console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done)

        generate(asked.output, asked.options, show)
    console.print(f"capture: {asked.output}", highlight=False)


def doctor(arguments: list[str]) -> int:
    asked = tyro.cli(DoctorArguments, args=arguments, prog="vdgs doctor")
    from vdgs.doctor import print_report

    return print_report(as_json=asked.json)


def _preset(arguments: list[str]) -> PresetName:
    """The preset named on the command line: it decides the defaults of all other options."""
    for place, argument in enumerate(arguments):
        value = argument.partition("=")[2] if argument.startswith("--preset=") else None
        if argument == "--preset" and place + 1 < len(arguments):
            value = arguments[place + 1]
        if value in PRESETS:
            return value  # type: ignore[return-value]
    return "paper"


def _use_threads(count: int) -> None:
    import torch

    from vdgs.kernels.native.module import set_threads, threads

    if count > 0:
        set_threads(count)
    torch.set_num_threads(max(1, threads()))


def _console():  # type: ignore[no-untyped-def]
    from rich.console import Console

    return Console(soft_wrap=True)
