"""The verb that writes a scene for other programs: `export_command`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from vdgs.cli.common import make_console, parse_arguments, set_up_compute
from vdgs.config.commands import ExportRequest, ProgramName
from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.ranges import WORKER_COUNT


@dataclass(frozen=True, kw_only=True)
class ExportArguments(ExportRequest):
    """Write the scene of a run as standard files of Gaussians or points, and say what is lost by it."""

    run: Positional[Path]
    """Run folder."""
    output: Annotated[tuple[Path, ...], UseAppendAction] = ()
    """A file to write, by its ending: .ply (3DGS), .compressed.ply (PlayCanvas), .spz, .splat, .sog, .glb (glTF),
    FOLDER/tileset.json (3D Tiles), .points.ply, .laz, .las (point clouds), .html (a page that shows the scene offline).
    Give --output again for more: the scene is baked once (docs/export.md)."""
    program: Annotated[ProgramName | None, arg(name="for")] = None
    """Turn the files for this program, so that it shows the scene upright, and refuse files that it does not open.
    Without --output: write RUN/export/ and the file that suits it best."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Shards of the baking done at once, each in a process of its own; 0: on this machine one process bakes all, a
    cluster as many as it has room for."""
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)


def export_command(arguments: list[str]) -> None:
    asked = parse_arguments(ExportArguments, arguments, "vdgs export")
    device, console = set_up_compute(asked.device, asked.threads), make_console(asked.quiet)
    from vdgs.distributed.sharded_job import ExecutionOptions
    from vdgs.export.export_run import export_run, resolve_request
    from vdgs.runs.open_run import open_run

    asked.executor_options.check()
    request = resolve_request(replace(asked, device=device))
    run = open_run(request.run, request.model, device)
    export_run(run, request, console, ExecutionOptions(asked.executor_options, asked.jobs, device=device))
    from vdgs.report.write_report import write_report
    from vdgs.runs.run_folder import REPORT_FILE

    if any(path.suffix.lower() == ".html" for path in request.output) and (asked.run / REPORT_FILE).exists():
        write_report(run.folder)  # it leads to the page
