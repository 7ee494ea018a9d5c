"""The verb that shows a run in a browser: `view_command`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from vdgs.cli.common import make_console, parse_arguments, select_device
from vdgs.config.commands import ViewRequest
from vdgs.kernels import configure_threads


@dataclass(frozen=True, kw_only=True)
class ViewArguments(ViewRequest):
    """Show a run in a browser: move through the true model, drawn on this machine; its layers (depth, V, alpha, blocks,
    errors), what is known of a clicked place, camera paths for `vdgs render --path`. Follows a run that still trains.

    Prints the address to open; Ctrl-C ends it. Needs viser: pip install 'vdgs[viewer]'.
    """

    run: Positional[Path]
    """Run folder."""


def view_command(arguments: list[str]) -> None:
    asked = parse_arguments(ViewArguments, arguments, "vdgs view")
    from vdgs.viewer.server import view_run

    device = select_device(asked.device)
    configure_threads(asked.threads)
    view_run(replace(asked, device=device), make_console())
