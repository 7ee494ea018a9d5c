"""What was trained on a capture that is made anew: it stays until the new capture takes the place of the old one."""

from __future__ import annotations

from pathlib import Path

from vdgs.captures.reconstruction import ANEW, OWN_CAPTURE, RECONSTRUCTION_FILE
from vdgs.captures.strays import is_run
from vdgs.config.sfm_options import SfmRequest
from vdgs.errors import RunError
from vdgs.runs.run_folder import RunFolder
from vdgs.sfm.source_images import SourceImages
from vdgs.sfm.workspace import Workspace


def run_of_capture(output: Path) -> RunFolder | None:
    """The run in whose folder a capture lies that is made of photographs (RUN/capture); None for captures elsewhere."""
    folder = output.resolve()
    return RunFolder(output.parent) if folder.name == OWN_CAPTURE and is_run(folder.parent) else None


def agree_to_discard(output: Path, key: str, run: RunFolder | None) -> None:
    """Record that work of this key may discard what was trained: the same command then goes on without --overwrite."""
    if run is not None and run.is_trained:
        Workspace(output).begin(ANEW, key)


def discard_training(output: Path, run: RunFolder | None) -> None:
    """Delete what was trained on a capture, right before another takes its place."""
    if run is not None:
        run.discard_training()
    Workspace(output).forget(ANEW)


def forget_agreement(output: Path) -> None:
    """Take back what `agree_to_discard` recorded: a capture that is there already was asked for meanwhile."""
    if Workspace(output).has_begun(ANEW):
        Workspace(output).forget(ANEW)


def check_nothing_trained(request: SfmRequest, run: RunFolder | None, key: str | None = None) -> None:
    """Raise RunError where a capture is about to change that a run was trained on, unless work of this `key` was begun
    with --overwrite. None: no work was begun."""
    agreed = request.overwrite or (key is not None and Workspace(request.output).is_begun_by_any(ANEW, key))
    if run is not None and run.is_trained and not agreed:
        if SourceImages.read(run.own_capture) is None and run.config_file.exists():
            raise RunError(
                f"{run.path}: is a run of the capture {run.settings().capture_path}, not of these photographs. Take "
                "another --output; --overwrite discards what was trained."
            )
        raise RunError(
            f"{run.path}: its capture was made with other positions or other settings of the reconstruction (--sfm.*, "
            "--gps), and the run was trained on it. Add --overwrite to do both again, give the old settings to "
            "continue, or take another --output."
        )


def check_trained_on_this(request: SfmRequest, run: RunFolder | None) -> None:
    """Raise RunError where a run was trained on its capture as that was before it was made anew or placed anew by
    another command; with --overwrite, delete what was trained instead. For a finished capture of these photographs."""
    if run is None or not run.is_trained:
        return
    now, then = (folder / RECONSTRUCTION_FILE for folder in (request.output, run.path))
    if not then.is_file() or now.read_bytes() == then.read_bytes():
        return
    if not request.overwrite:
        raise RunError(
            f"{run.path}: its capture was made or placed anew since the run was trained on it. Add --overwrite to "
            "train on it as it is now, or take another --output."
        )
    with run.drive_lock():
        run.discard_training()
