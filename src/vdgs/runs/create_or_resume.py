"""A new run, or a run that continues: its capture opened, its settings checked and saved."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import capture_fingerprint, check_same_capture
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import check_not_among_inputs, check_output
from vdgs.captures.place_facts import measure_place
from vdgs.captures.reconstruction import RECONSTRUCTION_FIGURE as RECONSTRUCTION_FIGURE
from vdgs.captures.reconstruction import RECONSTRUCTION_FILE as RECONSTRUCTION
from vdgs.captures.reconstruction import place_name
from vdgs.captures.validation import require_valid
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.method import MethodConfig, resolve_iterations
from vdgs.config.validation_rules import check_config
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_settings import RunSettings, with_absolute_paths
from vdgs.system.atomic_files import read_json, read_json_or_empty, to_jsonable, write_bytes, write_json
from vdgs.system.records import record_to_dict


def create_or_resume_run(
    capture_path: Path,
    output: Path,
    capture_options: CaptureOptions,
    method: MethodConfig,
    *,
    overwrite: bool | None = None,
    command: str | None = None,
    capture: Capture | None = None,
) -> RunContext:
    """Open the capture and a new run of it, or the run that is there if it was started with the same settings.

    `overwrite` None compares the settings of the coarse stage only and refuses others; True or False is about changing
    them (`RunFolder.change_settings`). `command` is the command line, saved in the run; `capture` the one in the
    folder, where it was read with these options before. Raises CaptureError for a capture that cannot be used,
    RunError for other settings than the run's and for a run that another process drives, VdgsError for settings that
    do not work and for an output among inputs.
    """
    with exclusive_run(
        capture_path, output, capture_options, method, overwrite=overwrite, command=command, capture=capture
    ) as context:
        return context


@contextmanager
def exclusive_run(
    capture_path: Path,
    output: Path,
    capture_options: CaptureOptions,
    method: MethodConfig,
    *,
    overwrite: bool | None = None,
    command: str | None = None,
    capture: Capture | None = None,
) -> Iterator[RunContext]:
    """As `create_or_resume_run`, with the lock of a driver (`RunFolder.drive_lock`) from before anything is written or
    removed to the end of the `with`. `capture` is the one of these options, if it is read already."""
    check_config(method)
    check_output(output)
    if capture is None:
        capture = load_capture(capture_path.resolve(), with_absolute_paths(capture_options, capture_path))
    check_not_among_inputs(output, capture)
    method = replace(method, training=resolve_iterations(method.training, len(capture.train_views)))
    settings = run_settings(capture_path, capture_options, method)
    run = RunFolder(output)
    if not run.config_file.exists():  # what cannot become a scene leaves no folder that other settings stumble over
        require_valid(capture)
    run.check_output_empty()
    context = RunContext(run, capture)
    with run.drive_lock():
        if overwrite and run.config_file.exists() and run.find_lost(settings):
            context.find_doubts()  # before anything is deleted for photographs that cannot be trained on
        _resume(run, capture, settings, overwrite, command)
        yield context


def _resume(
    run: RunFolder, capture: Capture, settings: RunSettings, overwrite: bool | None, command: str | None
) -> None:
    """Save the settings of a run that this process drives, new ones or others; what they make useless is deleted."""
    # Where nothing changes its blocks may be at work, begun by a driver that died.
    continues = run.config_file.exists() and run.capture_file.exists() and run.settings() == settings
    with run.locked(shared=continues):
        is_read_anew = run.config_file.exists() and capture_options_changed(run, settings)
        if run.capture_file.exists() and not is_read_anew:
            check_same_capture(run.capture_file, read_json(run.capture_file), capture)
        if overwrite is None or not run.config_file.exists():
            run.create_or_check(settings, ("capture", "training"), command)
            run.move_capture(Path(settings.capture_path))
        else:
            run.change_settings(settings, overwrite, command)
            if is_read_anew:  # nothing is left that was made of it; the coarse stage writes the new one
                run.capture_file.unlink(missing_ok=True)
        _copy_reconstruction(capture.root, run.path)
        _write_place(capture, run)


def capture_options_changed(run: RunFolder, settings: RunSettings) -> bool:
    """Whether the run reads its capture with other options: a difference of captures is due to these then."""
    return run.settings().moved(Path(settings.capture_path)).capture != settings.capture


def _copy_reconstruction(root: Path, run: Path) -> None:
    """Copy how the capture was made of photographs, if it was made here: the report reads the run alone."""
    for name in (RECONSTRUCTION, RECONSTRUCTION_FIGURE):
        if (root / name).is_file():
            content = (root / name).read_bytes()
            if not (run / name).is_file() or (run / name).read_bytes() != content:
                write_bytes(run / name, content)


def _write_place(capture: Capture, run: RunFolder) -> None:
    """Save the facts of the place that the report and `vdgs status` begin with, unless they are there, of this name."""
    fingerprint, saved = capture_fingerprint(capture), read_json_or_empty(run.place_file)
    if (saved.get("fingerprint"), saved.get("name")) != (fingerprint, place_name(capture.root)):
        write_json(run.place_file, to_jsonable(record_to_dict(measure_place(capture)) | {"fingerprint": fingerprint}))


def run_settings(capture_path: Path, capture_options: CaptureOptions, method: MethodConfig) -> RunSettings:
    """The settings in config.yaml: everything that the result depends on."""
    return RunSettings.create(capture_path.resolve(), with_absolute_paths(capture_options, capture_path), method)
