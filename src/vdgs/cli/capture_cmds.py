"""Verbs about captures: look at one (`inspect`), generate one (`synth`), make one of photographs (`sfm`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape

from vdgs.cli.common import QuietArguments, make_console, parse_arguments
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.output_paths import Output
from vdgs.config.ranges import WORKER_COUNT, FlagName, Positional
from vdgs.config.sfm_options import SfmOptions, SfmRequest
from vdgs.config.typed_paths import MaybeFolder
from vdgs.errors import CaptureError
from vdgs.synth.synth_options import SynthOptions
from vdgs.system.quoting import shell_line

if TYPE_CHECKING:
    from rich.console import Console

    from vdgs.runs.run_folder import RunFolder


@dataclass(frozen=True)
class InspectArguments:
    """Say what a capture holds, whether it can become a scene, and how well its photographs cover the place, in a table
    and figures. Fails where training would be pointless."""

    capture: Annotated[Path, Positional()]
    """Folder of the capture."""
    output: Annotated[Path, Output()]
    """Folder for report.json and the figures."""
    check: bool = True
    """Decode every photograph once, to find damaged ones."""
    options: Annotated[CaptureOptions, FlagName("")] = field(default_factory=CaptureOptions)


def inspect_command(arguments: list[str]) -> None:
    args = parse_arguments(InspectArguments, arguments, "inspect")
    from vdgs.captures.image_checks import check_images
    from vdgs.captures.loading import load_capture
    from vdgs.captures.output_guard import check_not_among_inputs
    from vdgs.captures.reconstruction import read_reconstruction
    from vdgs.report.capture_report import inspect_capture, print_report

    capture = load_capture(args.capture, args.options)
    check_not_among_inputs(args.output, capture)
    report = inspect_capture(capture, args.output, check_images(capture) if args.check else None)
    print_report(report, reconstruction_report=read_reconstruction(capture.root))
    if report.problems:
        raise CaptureError(f"{capture.root}: cannot become a scene; see the problems above.")


@dataclass(frozen=True)
class SynthArguments(QuietArguments):
    """Generate an aerial place and a drone flight over it, as a COLMAP capture."""

    output: Annotated[Path, Positional(), Output()]
    """Folder for the capture; it must not exist or be empty."""
    options: Annotated[SynthOptions, FlagName("")] = field(default_factory=SynthOptions)


def synth_command(arguments: list[str]) -> None:
    args = parse_arguments(SynthArguments, arguments, "synth")
    from rich.progress import TaskID

    from vdgs.synth import generate
    from vdgs.system.console import make_progress_bar

    console = make_console(args.quiet)
    with make_progress_bar(console, transient=False) as bar:
        tasks: dict[str, TaskID] = {}

        def on_progress(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done)

        result = generate(args.output, args.options, on_progress)
    console.print(f"{result.summary}\ncapture: {args.output}", highlight=False)


@dataclass(frozen=True, kw_only=True)
class SfmArguments(QuietArguments):
    """Photographs to a capture: features, matches, poses and points, metres and north from their positions, photographs
    without lens distortion in three sizes. The same command goes on where it was stopped. Photographs are only read."""

    images: Annotated[tuple[Path, ...], Positional("PHOTOGRAPHS")]
    """Folders of photographs, those below them included, or films. Of films frames are taken, by how far the picture
    moved and how sharp it is; or a project of another program that has poses and no points (Metashape, RealityScan,
    ODM, ..., or transforms.json of nerfstudio, instant-ngp, Blender): points are found, with poses and lenses as the
    project has them. A folder masks/ beside photographs has their masks (white = keep), named like them: name.png or
    name.jpg.png; name_mask.jpg beside name.jpg is one too."""
    output: Annotated[Path, Output()]
    """Folder of the capture; new, or the one to go on with."""
    project_images: Annotated[str | None, FlagName("images"), MaybeFolder()] = None
    """Folder of the photographs of a project of another program. Default: images beside it, or its whole folder."""
    gps: Path | None = None
    """Table of positions to use instead of those in the photographs: columns name,lat,lon,alt as exiftool, Metashape,
    Pix4D, RealityScan and others name them, ODM's geo.txt or DJI's .MRK. Names need no folder and no extension where
    they are told apart without."""
    dry_run: bool = False
    """Say what the photographs hold, what would be done and how long it takes, and write nothing."""
    threads: Annotated[int, WORKER_COUNT] = 0
    """Threads to use; 0 for all cores."""
    keep_intermediate: bool = False
    """Keep COLMAP's database and models in OUTPUT/work once all is done."""
    overwrite: bool = False
    """Make the capture anew where photographs differ. They were added, removed or changed since it was begun."""
    options: Annotated[SfmOptions, FlagName("")] = field(default_factory=SfmOptions)


def sfm_command(arguments: list[str]) -> None:
    args = parse_arguments(SfmArguments, arguments, "sfm")
    from vdgs.captures.format_dispatch import lacks_points
    from vdgs.captures.output_guard import is_capture
    from vdgs.sfm.discarding import run_of_capture
    from vdgs.sfm.image_list import HOW_TO_MAKE_NEW_POSES

    request = SfmRequest(
        image_folders=args.images, output=args.output, gps=args.gps, threads=args.threads,
        keep_intermediate=args.keep_intermediate, overwrite=args.overwrite, options=args.options,
    )  # fmt: skip
    console = make_console(args.quiet and not args.dry_run)
    options = CaptureOptions(images=args.project_images)
    try:
        is_posed = len(args.images) == 1 and lacks_points(args.images[0], options)
    except CaptureError as error:
        raise CaptureError(f"{error}\n{HOW_TO_MAKE_NEW_POSES}") from error
    if args.project_images is not None and not is_posed and not any(map(is_capture, args.images)):
        raise CaptureError(
            f"--images {args.project_images}: is for projects, whose photographs lie elsewhere. Of photographs alone "
            "give their own folder, without --images."
        )
    run = run_of_capture(args.output)
    if args.dry_run:
        _print_sfm_plan(request, options, is_posed, console, run)
        return
    if is_posed:
        from vdgs.sfm.posed_capture import make_posed_capture

        make_posed_capture(request, options, console, run)
    else:
        from vdgs.sfm.reconstruct import reconstruct

        reconstruct(request, console, run)
    capture = args.output.resolve()
    words = [f"{capture}-run", "--preset", "laptop"] if run is None else [run.path]
    after = shell_line(["vdgs", "run", capture, "--output", *words])
    console.print(escape(f"capture: {args.output}\nnext: {after}"), highlight=False)


def _print_sfm_plan(
    request: SfmRequest, options: CaptureOptions, is_posed: bool, console: Console, run: RunFolder | None
) -> None:
    """Say what `vdgs sfm` would do, of photographs alone or with poses (`is_posed`), where it makes the capture of a
    `run`."""
    if is_posed:
        from vdgs.sfm.posed_plan import plan_posed_capture, print_posed_plan

        print_posed_plan(*plan_posed_capture(request, options), console)
    else:
        from vdgs.sfm.films.take_frames import temporary_frames
        from vdgs.sfm.reconstruct import describe_work_left, look_at_work
        from vdgs.sfm.reconstruction_plan import print_plan
        from vdgs.sfm.sfm_estimate import estimate_sfm

        with temporary_frames(request, console) as with_frames:
            plan, left = look_at_work(with_frames, run)
            if said := describe_work_left(request, left):
                console.print(escape(said), highlight=False)
            print_plan(plan, estimate_sfm(plan).text(plan.threads) if left == "all" else "", console)
    console.print("Nothing was written.", highlight=False)
