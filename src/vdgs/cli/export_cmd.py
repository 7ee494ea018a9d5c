"""The verb that writes a scene for other programs: `export_command`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from vdgs.cli.common import QuietArguments, ShardArguments, make_console, parse_arguments, set_up_compute
from vdgs.config.commands import ExportRequest, ProgramName
from vdgs.config.output_paths import Output


@dataclass(frozen=True, kw_only=True)
class ExportArguments(ExportRequest, ShardArguments, QuietArguments):
    """Write the scene of a run as standard files of Gaussians or points, and say what is lost by it."""

    run: Positional[Path]
    """Run folder."""
    output: Annotated[tuple[Path, ...], UseAppendAction, Output()] = ()
    """A file to write, by its ending: .ply (3DGS), .compressed.ply (PlayCanvas), .spz, .splat, .sog, .glb (glTF),
    FOLDER/tileset.json (3D Tiles), .points.ply, .laz, .las (point clouds), .html (a page that shows the scene offline).
    Give --output again for more: the scene is baked once (docs/export.md)."""
    program: Annotated[ProgramName | None, arg(name="for")] = None
    """Turn the files for this program, so that it shows the scene upright, and refuse files that it does not open.
    Without --output: write RUN/export/ and the file that suits it best."""


def export_command(arguments: list[str]) -> None:
    args = parse_arguments(ExportArguments, arguments, "vdgs export")
    device, console = set_up_compute(args.device, args.threads), make_console(args.quiet)
    from vdgs.export.export_run import export_run, resolve_request
    from vdgs.runs.open_run import open_run

    execution, request = args.execution(device), resolve_request(replace(args, device=device))
    run = open_run(request.run, request.model, device)
    export_run(run, request, console, execution)
    from vdgs.report.write_report import write_report
    from vdgs.runs.run_folder import REPORT_FILE

    if any(path.suffix.lower() == ".html" for path in request.output) and (args.run / REPORT_FILE).exists():
        write_report(run.folder)  # it links to the page
