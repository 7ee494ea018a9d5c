"""The verb that writes a scene for other programs: `export`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction

from vdgs.settings.requests import ExportRequest
from vdgs.verbs.shared import open_console, parse, use_device, use_threads


@dataclass(frozen=True)
class ExportArguments(ExportRequest):
    """Write the scene of a run as standard files of Gaussians or points, and say what is lost by it."""

    run: Positional[Path]
    """Run folder."""
    to: Annotated[tuple[Path, ...], UseAppendAction] = ()
    """A file to write, by its ending: .ply (3DGS), .spz, .splat, .sog, .glb (glTF), FOLDER/tileset.json (3D Tiles),
    .points.ply, .laz, .las (point clouds), .html (a page that shows the scene offline). Give --to again for more: the
    scene is baked once (docs/export.md)."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""


def export(arguments: list[str]) -> None:
    asked = parse(ExportArguments, arguments, "vdgs export")
    from vdgs.export.exporting import export_run

    device = use_device(asked.device)
    use_threads(asked.threads)
    export_run(replace(asked, device=device), open_console(asked.quiet))
    from vdgs.report.write import FILE, write_report
    from vdgs.runs.folder import RunFolder

    if any(path.suffix.lower() == ".html" for path in asked.to) and (asked.run / FILE).exists():
        write_report(RunFolder(asked.run))  # it leads to the page
