"""Verbs that show the results of a run: `status`, `eval`, `report`, `render`, `ortho`, `view`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from vdgs.cli.common import (
    CaptureArguments,
    QuietArguments,
    ShardArguments,
    StageArguments,
    make_console,
    parse_arguments,
    set_up_compute,
)
from vdgs.config.commands import (
    BIN_COUNT_RANGE,
    MAX_RENDER_SIDE_PX,
    ComputeOptions,
    ExportRequest,
    ModelName,
    OrthoRequest,
    RenderRequest,
    RunPath,
    ViewRequest,
)
from vdgs.config.output_paths import Output
from vdgs.config.ranges import Positional, Range
from vdgs.errors import RunError, VdgsError


@dataclass(frozen=True, kw_only=True)
class StatusArguments(RunPath):
    """Say how far a run is, stage by stage and block by block, and what to type next.

    Stages are done, running, queued, stopped (they continue), failed (with the reason), missing, stale (made with other
    settings, for another cut or from another model) or unknown (no record says it). Exit code 0: all is done and in
    date; 3: not so.
    """

    json: bool = False
    """Print JSON instead of lines."""


def status_command(arguments: list[str]) -> int:
    args = parse_arguments(StatusArguments, arguments, "status")
    from vdgs.report.status_cli import EXIT_INCOMPLETE, print_status, status_json
    from vdgs.runs.run_folder import RunFolder

    if not args.json:
        return print_status(RunFolder(args.run), make_console())
    import json

    content = status_json(RunFolder(args.run))
    print(json.dumps(content, indent=1, ensure_ascii=False))
    return 0 if content["complete"] else EXIT_INCOMPLETE


@dataclass(frozen=True, kw_only=True)
class EvalArguments(ShardArguments, ComputeOptions, StageArguments):
    """Render the test views of a run and measure them: metrics.json, per_view.json, pictures, a table. Where the
    capture has a folder off_path, its views from where nobody flew are measured too, by themselves."""

    model: ModelName = "best"
    """Which model; `best` is the merged one where there is one."""
    views: Literal["test", "training", "off-path"] = "test"
    """Which views. `off-path` goes into evaluation_off_path and counts pixels that three training cameras see; `test`
    includes it. `training` goes into evaluation_training: a model that is much better there than on test views
    overfits. Blocks and seams are measured on test views only."""
    lod_error: Annotated[float | None, Range(0, MAX_RENDER_SIDE_PX)] = None
    """Draw through the run's level-of-detail tree (`vdgs lod`), at most so many pixels off. The figures go into
    evaluation_lod_PX; blocks and seams are not measured."""
    lpips_weights: Path | None = None
    """VGG16 weights for LPIPS (torchvision's vgg16 state dict, .pth or .safetensors). Nothing is downloaded."""
    visibility_bins: Annotated[int, BIN_COUNT_RANGE] = 4
    """Number of visibility quantiles by which metrics are reported."""


def eval_command(arguments: list[str]) -> None:
    args = parse_arguments(EvalArguments, arguments, "eval")
    from vdgs.pipeline.evaluate_stage import EvaluationRequest, evaluate_stage
    from vdgs.runs.run_context import RunContext

    device = set_up_compute(args.device, args.threads)
    request = EvaluationRequest(
        path=args.run,
        which=args.model,
        lpips_weights=args.lpips_weights,
        visibility_bins=args.visibility_bins,
        views=args.views,
        device=device,
        lod_error=args.lod_error,
    )
    context = RunContext.from_path(args.run, args.capture)
    evaluate_stage(context, request, make_console(args.quiet), args.execution(device))


#: What a run may have, however damaged it is.
_RUN_PARTS = ("config.yaml", "capture.json", "capture", "coarse", "partition", "blocks", "merged", "evaluation")


@dataclass(frozen=True, kw_only=True)
class ReportArguments(RunPath, QuietArguments):
    """Write RUN/report.html: one file with the figures, metrics, pictures and settings of a run."""

    run: Annotated[Path, Positional()]
    """Run folder; what is damaged or missing is left out."""


def report_command(arguments: list[str]) -> None:
    args = parse_arguments(ReportArguments, arguments, "report")
    if not any((args.run / part).exists() for part in _RUN_PARTS):
        raise RunError(f"{args.run}: holds nothing of a run. Train first: vdgs run CAPTURE --output RUN")
    from vdgs.report.write_report import write_report
    from vdgs.runs.run_folder import RunFolder

    make_console(args.quiet).print(f"report: {write_report(RunFolder(args.run))}", highlight=False)


@dataclass(frozen=True, kw_only=True)
class RenderArguments(RenderRequest, QuietArguments):
    """Render a run: its test views, its training views, or a camera path; as PNG files or a video."""


def render_command(arguments: list[str]) -> None:
    args = parse_arguments(RenderArguments, arguments, "render")
    from vdgs.rendering.render_run import render_run

    render_run(replace(args, device=set_up_compute(args.device, args.threads)), make_console(args.quiet))


@dataclass(frozen=True, kw_only=True)
class OrthoArguments(OrthoRequest, ShardArguments, QuietArguments, CaptureArguments):
    """Make maps of a run: orthophoto, surface model and visibility as GeoTIFFs, hillshade and preview as PNG.

    Needs rasterio and pyproj: pip install 'vdgs[geo]'.
    """


def ortho_command(arguments: list[str]) -> None:
    args = parse_arguments(OrthoArguments, arguments, "ortho")
    from vdgs.rendering.ortho.render_ortho import render_ortho
    from vdgs.runs.run_context import RunContext

    device = set_up_compute(args.device, args.threads)
    execution, context = args.execution(device), RunContext.from_path(args.run, args.capture)
    render_ortho(context, replace(args, device=device), make_console(args.quiet), execution)


@dataclass(frozen=True, kw_only=True)
class ViewArguments(ViewRequest, CaptureArguments):
    """Show a run in a browser: move through the true model, drawn on this machine; its layers (depth, V, alpha, blocks,
    errors), what is known of a clicked place, camera paths for `vdgs render --path`. Follows a run that still trains.

    Prints the address to open; Ctrl-C ends it. Needs viser: pip install 'vdgs[viewer]'.
    """

    static: Annotated[Path | None, Output()] = None
    """Folder to write for any web server: a page that loads near parts finely. Nothing is served then. With fixed
    colors, not the true model. Options of a smaller or better one: `vdgs export --output FOLDER/scene.json`."""


def view_command(arguments: list[str]) -> None:
    args = parse_arguments(ViewArguments, arguments, "view")
    if args.capture is not None:
        from vdgs.runs.open_run import relocate_capture
        from vdgs.runs.run_folder import RunFolder

        relocate_capture(RunFolder(args.run), args.capture)
    if args.static is not None:
        write_static_viewer(args, args.static)
        return
    from vdgs.viewer.server import view_run

    view_run(replace(args, device=set_up_compute(args.device, args.threads)), make_console())


def write_static_viewer(args: ViewArguments, folder: Path) -> None:
    """Write the folder of `--static`, and say how it is served."""
    device, console = set_up_compute(args.device, args.threads), make_console()
    from vdgs.export.export_run import export_run, resolve_request
    from vdgs.export.formats.streamed_page import SCENE_FILE
    from vdgs.runs.open_run import open_run
    from vdgs.system.quoting import shell_word

    if args.port is not None or args.host != ViewRequest.host:
        raise VdgsError("--static writes a folder and serves nothing: leave out --host and --port.")
    request = ExportRequest(
        run=args.run, output=(folder / SCENE_FILE,), model=args.model, threads=args.threads, device=device
    )
    request = resolve_request(request)
    export_run(open_run(request.run, request.model, device), request, console)
    console.print(
        f"{folder}: any web server serves it. Here: (cd {shell_word(folder)} && python -m http.server), then open "
        "http://localhost:8000",
        highlight=False,
    )
