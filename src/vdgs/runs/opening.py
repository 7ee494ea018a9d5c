"""A run opened for looking at it or for building on it: its capture, and one of its models."""

from __future__ import annotations

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
from vdgs.runs.status import Status
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

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return self.model.anchors.positions.device


def open_run(path: Path, which: ModelName = "best", device: torch.device | str = "cpu") -> TrainedRun:
    """Open a run, its model on a device.

    Raises RunError if it is none or not trained, CaptureError if its photographs are gone.
    """
    folder = RunFolder(path)
    capture = open_capture(folder)
    name = which
    if which == "best":
        name = "merged" if folder.merged.is_done(folder.keys().merge) else "coarse"
    stage = folder.merged if name == "merged" else folder.coarse
    key = folder.keys().merge if name == "merged" else folder.keys().coarse
    if not stage.is_done(key):
        if folder.gaussians.path.is_dir():
            raise RunError(
                f"{path}: is a run of 3DGS from `vdgs bench`; only runs with anchors can be opened. Its pictures and "
                f"figures are in {path / 'evaluation'}."
            )
        verb = "vdgs merge RUN" if name == "merged" else "the same `vdgs coarse` or `vdgs run` command"
        raise RunError(
            f"{path}: has no {name} model of its settings yet (state: {stage.status().state}). Run {verb} (again): "
            "training continues from the last checkpoint."
        )
    model = AnchorModel.load(stage.model).to(torch.device(device))
    refuse_another_capture(stage.model, model.facts.get("capture", {}), capture)
    return TrainedRun(folder, capture, model, stage.model, name, stage.status())


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
