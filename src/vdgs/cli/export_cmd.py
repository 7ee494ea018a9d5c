"""The verb that writes a scene for other programs: `export_command`."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vdgs.cli.common import (
    CaptureArguments,
    QuietArguments,
    ShardArguments,
    make_console,
    parse_arguments,
    set_up_compute,
)
from vdgs.config.commands import ExportRequest


@dataclass(frozen=True, kw_only=True)
class ExportArguments(ExportRequest, ShardArguments, QuietArguments, CaptureArguments):
    """Write the scene of a run as standard files of Gaussians or points, and say what is lost by it."""


def export_command(arguments: list[str]) -> None:
    args = parse_arguments(ExportArguments, arguments, "export")
    device, console = set_up_compute(args.device, args.threads), make_console(args.quiet)
    from vdgs.export.export_run import export_run, resolve_request
    from vdgs.runs.open_run import open_run, relocate_capture
    from vdgs.runs.run_folder import REPORT_FILE, RunFolder

    execution, request = args.execution(device), resolve_request(replace(args, device=device))
    if args.capture is not None:
        relocate_capture(RunFolder(args.run), args.capture)
    run = open_run(request.run, request.model, device)
    export_run(run, request, console, execution)
    if any(path.suffix.lower() == ".html" for path in request.output) and (args.run / REPORT_FILE).exists():
        from vdgs.report.write_report import link_exports

        link_exports(run.folder, console)
