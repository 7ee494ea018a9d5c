"""Whether `vdgs run` has nothing to do, found out without the libraries that its stages need."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from vdgs.config.commands import RunRequest
from vdgs.errors import VdgsError
from vdgs.evaluation.measured_as import is_evaluated
from vdgs.rendering.ortho.map_status import has_ortho_dependencies, is_ortho_current
from vdgs.report.status_cli import full_run_status, next_line
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_inputs import are_inputs_unchanged
from vdgs.runs.run_settings import with_absolute_paths
from vdgs.sfm.source_images import SourceImages

#: Options of `vdgs run`, beside `--sfm.*` and the folders (words without an option), that a capture of photographs
#: depends on; a file of settings may name a table of positions or a scale bar.
_PHOTOGRAPH_FLAGS = ("", "--gps", "--scale-bar", "--config")


def nothing_to_do(request: RunRequest, command: str) -> str:
    """What to say of a run that is whole, with the settings of the request and of inputs that are as they were; empty
    for all others, which the stages look at more closely."""
    run = RunFolder(request.output)
    if not run.config_file.is_file():
        return ""
    try:
        same = _same_request(run, request, command) and _is_whole(run, request)
        if not (same and are_inputs_unchanged(run, request)):
            return ""
    except (OSError, VdgsError):
        return ""
    return f"nothing to do: {run.path} is whole\n{next_line(full_run_status(run))}"


def _same_request(run: RunFolder, request: RunRequest, command: str) -> bool:
    """Whether the run has the settings that are asked for, and is of this capture or of these photographs."""
    own = run.settings()
    if request.capture.resolve() != Path(own.capture_path):
        if run.config.command() != command and not same_photographs(run, command):
            return False
        gps, scale_bar = own.capture.gps, own.capture.scale_bar  # used by the reconstruction of the photographs alone
        request = replace(request, options=replace(request.options, gps=gps, scale_bar=scale_bar))
    method, training = request.method(), request.training
    if not training.iterations:  # follows from the number of photographs, which are the same
        method = replace(method, training=replace(training, iterations=own.training.iterations))
    return method == own.method and with_absolute_paths(request.options, request.capture) == own.capture


def same_photographs(run: RunFolder, command: str) -> bool:
    """Whether a command names the photographs that the run made its capture of, with the options that it was made with:
    other words about the method, or another place of the run, do not count."""
    made = SourceImages.read(run.own_capture)
    if made is None or Path(run.settings().capture_path) != run.own_capture.resolve():
        return False
    return (made.command or "").startswith("vdgs run ") and _about_photographs(made.command or "") == (
        _about_photographs(command)
    )


def _about_photographs(command: str) -> list[list[str]]:
    """The words of `vdgs run` that say of which photographs a capture is made, and how."""
    groups = [[""]]
    for word in shlex.split(command)[2:]:
        groups = [*groups, [word]] if word.startswith("--") else [*groups[:-1], [*groups[-1], word]]
    kept = [group for group in groups if "sfm." in group[0] or group[0] in _PHOTOGRAPH_FLAGS]
    return sorted(kept)


def _is_whole(run: RunFolder, request: RunRequest) -> bool:
    measured = (
        is_evaluated(run, name, request.lpips_weights, request.visibility_bins) for name in ("coarse", "merged")
    )
    maps = not request.ortho or not has_ortho_dependencies() or is_ortho_current(run)
    status = full_run_status(run)
    return status.is_complete and not status.is_running and maps and all(measured)
