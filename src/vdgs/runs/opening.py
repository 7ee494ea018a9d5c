"""A run opened for looking at it or for building on it: its capture, and one of its models."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vdgs.captures.capture import Capture
from vdgs.captures.facts import refuse_another_capture
from vdgs.captures.loading import load_capture
from vdgs.errors import RunError
from vdgs.model.anchor_model import AnchorModel
from vdgs.runs.folder import RunFolder
from vdgs.runs.standing import standing_of
from vdgs.runs.status import Status
from vdgs.runs.vouching import load_vouched
from vdgs.settings.capture import CaptureOptions
from vdgs.settings.requests import ModelName


@dataclass(frozen=True)
class TrainedRun:
    """A run opened for looking at it: its capture as it was trained on, and its model."""

    folder: RunFolder
    capture: Capture
    model: AnchorModel
    model_path: Path
    #: Which model it is, "coarse" or "merged", and the status of the stage that made it.
    name: str
    status: Status
    #: Of the settings that it was made with (`runs.keys`).
    key: str | None = None
    #: Why it is not the model that one would expect (no merged one, or one that is out of date); empty where it is.
    caution: str = ""

    @property
    def line(self) -> str:
        """Which model it is, in a few words."""
        size = self.model_path.stat().st_size / 1e6
        return f"{self.name} model ({len(self.model.anchors):,} anchors, {size:,.1f} MB)"

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return self.model.anchors.positions.device


def open_run(path: Path, which: ModelName = "best", device: torch.device | str = "cpu") -> TrainedRun:
    """Open a run, its model on a device.

    Raises RunError if it is none or not trained, CaptureError if its photographs are gone.
    """
    folder = RunFolder(path)
    capture, keys = open_capture(folder), folder.keys()
    name = which
    if which == "best":
        name = "merged" if folder.merged.is_done(keys.merge) else "coarse"
    stage, key = (folder.merged, keys.merge) if name == "merged" else (folder.coarse, keys.coarse)
    if not stage.is_done(key):
        raise RunError(_not_there(folder, name))
    model = load_vouched(stage, key).to(torch.device(device))
    refuse_another_capture(stage.model, model.facts.get("capture", {}), capture)
    caution = _caution(folder, name) if which != "coarse" else ""
    return TrainedRun(folder, capture, model, stage.model, name, stage.status(), key, caution)


def _not_there(folder: RunFolder, name: str) -> str:
    """Why a model cannot be opened, and what to do."""
    if folder.gaussians.path.is_dir():
        return (
            f"{folder.path}: is a run of 3DGS from `vdgs bench`; only runs with anchors can be opened. Its pictures "
            f"and figures are in {folder.evaluation}."
        )
    standing = standing_of(folder)
    found = standing.of("merge" if name == "merged" else "coarse")
    why = f"state: {found.state}" + (f", {found.why}" if found.why else "")
    command = standing.next_command()
    return f"{folder.path}: has no {name} model of its settings yet ({why})." + (
        f" Next: {command}" if command else " A process works on it: wait for it."
    )


def _caution(folder: RunFolder, name: str) -> str:
    """What to say of a model that is not the merged one, or of a merged one that is out of date."""
    standing = standing_of(folder)
    merged = standing.of("merge")
    if merged.state == "done":
        return merged.why
    again = f"Next: {command}" if (command := standing.next_command()) else "A process works on the run."
    if name == "merged":
        return f"the merged model is out of date: {merged.why}. Merge again: vdgs merge {shlex.quote(str(folder.path))}"
    state = f"there is one that was {merged.why}" if merged.state == "stale" else "there is none yet"
    return f"this is the coarse model, not the merged one: {state}. {again}"


def open_capture(folder: RunFolder) -> Capture:
    """The capture of a run, read as the run was started. Raises CaptureError if it is gone or changed its form."""
    settings = dict(folder.settings()["capture"])
    root = Path(settings.pop("path"))
    return load_capture(root, options_from(settings, folder.config_file))


def options_from(settings: dict[str, Any], source: Path) -> CaptureOptions:
    """CaptureOptions from the plain values of config.yaml. Raises RunError on unknown settings."""
    paths = {"gps", "georef", "test_list", "undistorted_folder"}
    values: Any = {name: Path(v) if name in paths and v is not None else v for name, v in settings.items()}
    try:
        return CaptureOptions(**values)
    except TypeError as error:
        raise RunError(f"{source}: holds capture settings that this version does not know ({error})") from error
