"""A run begun, or taken up again: the capture opened, its settings checked and written down."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import check_not_among_inputs, check_not_in_capture
from vdgs.captures.reconstruction import RECONSTRUCTION_FIGURE as RECONSTRUCTION_FIGURE
from vdgs.captures.reconstruction import RECONSTRUCTION_FILE as RECONSTRUCTION
from vdgs.captures.validation import require_valid
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig, resolve_iterations
from vdgs.config.validation_rules import validate_config
from vdgs.errors import VdgsError
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings
from vdgs.system.atomic_files import read_json, write_bytes


def create_or_resume_run(
    capture_path: Path,
    output: Path,
    capture_options: CaptureOptions,
    method: MethodConfig,
    *,
    overwrite: bool | None = None,
    command: str | None = None,
) -> RunContext:
    """Open the capture and a new run of it, or the run that is there if it was started with the same settings.

    `redo` None compares the settings of the coarse stage only and refuses others; True or False is about changing
    them (`RunFolder.change_settings`). `command` is the one that asks, kept in the run. Raises CaptureError for a
    capture that cannot be used, RunError for other settings than the run's and for a run that another process drives,
    VdgsError for settings that do not work and for an output among inputs.
    """
    with exclusive_run(capture_path, output, capture_options, method, overwrite=overwrite, command=command) as begun:
        return begun


@contextmanager
def exclusive_run(
    capture_path: Path,
    output: Path,
    capture_options: CaptureOptions,
    method: MethodConfig,
    *,
    overwrite: bool | None = None,
    command: str | None = None,
) -> Iterator[RunContext]:
    """As `create_or_resume_run`, for who takes the run from stage to stage: it is driven (`RunFolder.driven`) from before anything
    of it is written or removed to the end of the `with`."""
    problems = validate_config(method)
    if problems:
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    check_not_in_capture(output)
    # Whole paths, as config.yaml holds them: stages hand the capture on, also to other machines.
    capture_path, capture_options = capture_path.resolve(), _with_whole_paths(capture_options)
    capture = load_capture(capture_path, capture_options)
    check_not_among_inputs(output, capture)
    method = replace(method, training=resolve_iterations(method.training, len(capture.train_views)))
    run = RunFolder(output)
    if not run.config_file.exists():  # what cannot become a scene leaves no folder that other settings stumble over
        require_valid(capture)
    run.check_output_empty()
    with run.drive_lock():
        _resume(run, capture, capture_path, run_settings(capture_path, capture_options, method), overwrite, command)
        yield RunContext(run, capture)


def _resume(
    run: RunFolder, capture: Capture, capture_path: Path, settings: RunSettings, overwrite: bool | None,
    command: str | None,
) -> None:  # fmt: skip
    """Write down the settings of a run that this process drives, new ones or others; what they make useless goes."""
    with run.locked(shared=_goes_on(run, settings)):
        read_anew = run.config_file.exists() and capture_options_changed(run, settings)
        if run.capture_file.exists() and not read_anew:
            check_same_capture(run.capture_file, read_json(run.capture_file), capture)
        if overwrite is None or not run.config_file.exists():
            run.create_or_check(settings, ("capture", "training"), command)
            run.move_capture(capture_path)
        else:
            run.change_settings(settings, overwrite, command)
            if read_anew:  # nothing is left that was made of it; what the coarse stage writes takes its place
                run.capture_file.unlink(missing_ok=True)
        _keep_reconstruction(capture.root, run.path)


def _goes_on(run: RunFolder, settings: RunSettings) -> bool:
    """Whether the run that is there has the very settings: nothing of it changes, and its blocks may be at work, begun
    by a driver that died."""
    return run.config_file.exists() and run.capture_file.exists() and run.settings() == settings


def capture_options_changed(run: RunFolder, settings: RunSettings) -> bool:
    """Whether the run reads its capture with other options: it is their change then that has to be spoken of."""
    return run.settings().capture != settings.capture


def _keep_reconstruction(root: Path, run: Path) -> None:
    """How the capture was made of photographs, where it was made here: for the report, which reads the run alone."""
    for name in (RECONSTRUCTION, RECONSTRUCTION_FIGURE):
        if (root / name).is_file():
            content = (root / name).read_bytes()
            if not (run / name).is_file() or (run / name).read_bytes() != content:
                write_bytes(run / name, content)


def run_settings(capture_path: Path, capture_options: CaptureOptions, method: MethodConfig) -> RunSettings:
    """What config.yaml holds: everything that the result depends on."""
    return RunSettings.of(capture_path.resolve(), _with_whole_paths(capture_options), method)


def _with_whole_paths(options: CaptureOptions) -> CaptureOptions:
    """Options whose files are named from the root of the disk: they mean the same in every folder."""
    whole: dict[str, Any] = {name: path.resolve() for name, path in vars(options).items() if isinstance(path, Path)}
    return replace(options, **whole)
