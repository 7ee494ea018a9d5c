"""A run opened for looking at it or for building on it: its capture, and one of its models."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vdgs.captures.capture import Capture
from vdgs.captures.facts import refuse_another_capture
from vdgs.captures.loading import load_capture
from vdgs.errors import CaptureError, RunError
from vdgs.model.anchor_model import AnchorModel
from vdgs.runs.folder import RunFolder
from vdgs.runs.status import Status
from vdgs.settings.capture import CaptureOptions
from vdgs.settings.plain import from_dict
from vdgs.settings.requests import ModelName
from vdgs.storage.files import read_json


@dataclass(frozen=True)
class OpenedModel:
    """One of the models of a run."""

    folder: RunFolder
    model: AnchorModel
    model_path: Path
    #: Which model it is, "coarse" or "merged", and the status of the stage that made it.
    name: str
    status: Status

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return self.model.anchors.positions.device


@dataclass(frozen=True)
class TrainedRun(OpenedModel):
    """A run opened for looking at it: one of its models, and its capture as it was trained on."""

    capture: Capture


def open_run(path: Path, which: ModelName = "best", device: torch.device | str = "cpu") -> TrainedRun:
    """Open a run, its model on a device.

    Raises RunError if it is none or not trained, CaptureError if its photographs are gone.
    """
    folder = RunFolder(path)
    capture = open_capture(folder)
    opened = open_model(folder, which, device)
    refuse_another_capture(opened.model_path, opened.model.facts.get("capture", {}), capture)
    return TrainedRun(**vars(opened), capture=capture)


def open_model(folder: RunFolder, which: ModelName = "best", device: torch.device | str = "cpu") -> OpenedModel:
    """Open a model of a run on a device, without the capture. Raises RunError if it is not trained."""
    path, name = folder.path, which
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
    return OpenedModel(
        folder, AnchorModel.load(stage.model).to(torch.device(device)), stage.model, name, stage.status()
    )


def open_capture(folder: RunFolder, at: Path | None = None) -> Capture:
    """The capture of a run, read as the run was started; `at` is where it lies if not where it lay.

    Raises CaptureError if it is gone or changed its form.
    """
    settings = dict(folder.settings()["capture"])
    written = Path(settings.pop("path"))
    if at is None and not written.is_dir():
        raise CaptureError(
            f"{written}: the capture of {folder.path} is not there. If it was moved, say where it lies now: "
            "--capture PATH."
        )
    return load_capture(at or written, options_from(settings, folder.config_file))


def remember_capture(folder: RunFolder, at: Path) -> None:
    """Let a run find its capture where it lies now. Raises RunError for another capture than the run's."""
    capture = open_capture(folder, at)
    with folder.locked():
        if folder.capture_file.exists():
            refuse_another_capture(folder.capture_file, read_json(folder.capture_file), capture)
        folder.move_capture(at)


def options_from(settings: dict[str, Any], source: Path) -> CaptureOptions:
    """CaptureOptions from the plain values of config.yaml. Raises RunError on settings that are none."""
    try:
        return from_dict(CaptureOptions, settings, "capture")
    except ValueError as error:
        raise RunError(f"{source}: {error}. Write it as it was, or start a new --output.") from error
