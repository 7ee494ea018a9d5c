"""Verbs about captures: look at one (`inspect_command`), generate one (`synth_command`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from vdgs.cli.common import make_console, parse_arguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.synth.options import SynthOptions


@dataclass(frozen=True)
class InspectArguments:
    """Say what a capture holds, whether it can become a scene, and how well its photographs cover the place, in a table
    and figures. Fails where training would be pointless."""

    capture: Positional[Path]
    """Folder of the capture."""
    output: Path
    """Folder for report.json and the figures."""
    check: bool = True
    """Decode every photograph once, to find damaged ones."""
    options: Annotated[CaptureOptions, arg(name="")] = field(default_factory=CaptureOptions)


def inspect_command(arguments: list[str]) -> None:
    asked = parse_arguments(InspectArguments, arguments, "vdgs inspect")
    from vdgs.captures.image_checks import check_images
    from vdgs.captures.loading import load_capture
    from vdgs.captures.output_guard import check_not_among_inputs, check_not_in_capture
    from vdgs.captures.reconstruction import read_reconstruction
    from vdgs.errors import CaptureError
    from vdgs.report.capture_report import inspect_capture, print_report

    check_not_in_capture(asked.output)
    capture = load_capture(asked.capture, asked.options)
    check_not_among_inputs(asked.output, capture)
    checked = check_images(capture) if asked.check else None
    report = inspect_capture(capture, asked.output, checked)
    print_report(report, reconstruction_report=read_reconstruction(capture.root))
    if report.problems:
        raise CaptureError(f"{capture.root}: cannot become a scene; see the problems above.")


@dataclass(frozen=True)
class SynthArguments:
    """Generate an aerial place and a drone flight over it, as a COLMAP capture."""

    output: Positional[Path]
    """Folder for the capture; it must not exist or be empty."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    options: Annotated[SynthOptions, arg(name="")] = field(default_factory=SynthOptions)


def synth_command(arguments: list[str]) -> None:
    asked = parse_arguments(SynthArguments, arguments, "vdgs synth")
    from rich.progress import Progress, TaskID

    from vdgs.synth import generate

    console = make_console(asked.quiet)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done)

        found = generate(asked.output, asked.options, show)
    console.print(f"{found.summary}\ncapture: {asked.output}", highlight=False)
