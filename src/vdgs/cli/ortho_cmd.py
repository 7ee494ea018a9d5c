"""The verb that makes maps of a run: `ortho_command`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from vdgs.cli.common import make_console, parse_arguments, select_device
from vdgs.config.commands import OrthoRequest
from vdgs.config.executor_options import ExecutorOptions
from vdgs.config.ranges import WORKER_COUNT
from vdgs.kernels import configure_threads


@dataclass(frozen=True, kw_only=True)
class OrthoArguments(OrthoRequest):
    """Make maps of a run: orthophoto, surface model and visibility as GeoTIFFs, hillshade and preview as PNG.

    Needs rasterio and pyproj: pip install 'vdgs[geo]'.
    """

    run: Positional[Path]
    """Run folder."""
    jobs: Annotated[int, WORKER_COUNT] = 0
    """Shards of the tiles drawn at once, each in a process of its own; 0: on this machine one process draws all, a
    cluster as many as it has room for."""
    quiet: bool = False
    """Print nothing but notes, warnings and errors."""
    executor_options: Annotated[ExecutorOptions, arg(name="")] = field(default_factory=ExecutorOptions)


def ortho_command(arguments: list[str]) -> None:
    asked = parse_arguments(OrthoArguments, arguments, "vdgs ortho")
    device = select_device(asked.device)
    configure_threads(asked.threads)
    from vdgs.distributed.sharded_job import ExecutionOptions
    from vdgs.rendering.ortho.render_ortho import render_ortho
    from vdgs.runs.run_context import RunContext

    asked.executor_options.check()
    wish = ExecutionOptions(asked.executor_options, asked.jobs, device=device)
    render_ortho(RunContext.from_path(asked.run), replace(asked, device=device), make_console(asked.quiet), wish)
