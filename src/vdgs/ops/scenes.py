"""What training leaves: scenes in memory, and run folders opened to look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from vdgs.captures.capture import Capture
from vdgs.config.commands import ModelName
from vdgs.config.method import MethodConfig
from vdgs.config.typed_paths import home_path
from vdgs.errors import CaptureError, RunError, VdgsError, check_kind
from vdgs.geometry.camera import Camera
from vdgs.kernels.device_selection import select_device
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.assignment.assign_cameras import Assignment
from vdgs.partition.blocks import Blocks
from vdgs.partition.merging import missing_message
from vdgs.runs import open_run as runs
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.tensors import REBUILD_HINT

#: What to do about a file that is no model and that no run wrote.
_LOADABLE = (
    "Give the model that Scene.save or a run wrote (model.safetensors); files of vdgs.export (.ply, .spz, ...) and of "
    "other programs hold Gaussians and cannot be loaded."
)


@dataclass(frozen=True, eq=False)
class Scene:
    """A trained scene: anchors with their decoder, and the capture that it was trained from."""

    model: AnchorModel
    #: None where it is not known (`Scene.load`) or gone: such a scene is drawn, but not exported.
    capture: Capture | None = None

    def __post_init__(self) -> None:
        check_kind("model", self.model, AnchorModel, remedy="vdgs.Scene.load(FILE) reads one")
        check_kind("capture", self.capture, Capture, type(None), remedy="vdgs.load_capture(FOLDER) reads one")

    def __len__(self) -> int:
        return len(self.model.anchors)

    def __repr__(self) -> str:
        return f"Scene({len(self):,} anchors, capture={self.capture!r})"

    @property
    def positions(self) -> Tensor:
        """Of the anchors, [n, 3] float32, ground frame."""
        return self.model.anchors.positions

    @property
    def cameras(self) -> list[Camera]:
        """The training cameras. Raises VdgsError where the capture is not known."""
        if self.capture is None:
            raise VdgsError("the scene does not know its capture: give it, as in Scene(model, capture)")
        return [view.camera for view in self.capture.train_views]

    def save(self, path: str | Path) -> None:
        """Write the model as one safetensors file, atomically. Raises VdgsError for a name of a format of `export`."""
        from vdgs.export.formats.registry import find_format

        path = home_path(path)
        other = find_format(path)
        if other is not None:
            raise VdgsError(
                f"{path}: the name is that of {other.suffix} ({other.description}), which vdgs.export(scene, path) "
                "writes. Let the name of a saved model end in .safetensors."
            )
        self.model.save(path)

    @staticmethod
    def load(path: str | Path, capture: Capture | None = None) -> Scene:
        """Read a model that `save` or a run wrote. Raises VdgsError for a missing, damaged or other file."""
        path = home_path(path)
        if path.is_dir():
            raise VdgsError(
                f"{path}: is a folder, not a model. vdgs.open_run(RUN).scene is the scene of a run, and "
                "vdgs.load_capture(FOLDER) reads a capture."
            )
        of_run = StageFolder(path.parent).status_file.is_file()
        return Scene(AnchorModel.load(path, remedy=REBUILD_HINT if of_run else _LOADABLE), capture)


class Run:
    """A run folder opened to look at; each part is read when first asked for. See `open_run`."""

    def __init__(self, folder: RunFolder, model: ModelName, device: str, capture: Path | None) -> None:
        self.folder, self.model, self.device = folder, model, device
        self._context = RunContext.from_path(folder.path, capture)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r}, model={self.model!r})"

    @property
    def path(self) -> Path:
        return self.folder.path

    @property
    def settings(self) -> MethodConfig:
        """What it was trained with."""
        return self.folder.method()

    @cached_property
    def capture(self) -> Capture:
        """Cameras, sparse points, ground frame, split. Raises CaptureError where it is gone."""
        return self._context.capture

    @cached_property
    def scene(self) -> Scene:
        """The model, with its capture where that is there. Raises RunError where it is not trained."""
        try:
            opened = self._context.open_model(self.model, self.device)
        except CaptureError:
            return Scene(runs.open_model(self.folder, self.model, self.device).model)
        return Scene(opened.model, opened.capture)

    @cached_property
    def blocks(self) -> Blocks:
        """The cut of the scene. Raises RunError where it is not cut with the run's settings."""
        return runs.load_run_blocks(self.folder)

    @cached_property
    def assignment(self) -> Assignment:
        """Which training cameras serve which block, and why: `cameras` [c, k] bool, `reasons`."""
        return runs.load_run_assignment(self.folder)

    @cached_property
    def block_scenes(self) -> list[Scene]:
        """The trained blocks, each with the anchors that it moves. Raises RunError where one is not trained, with the
        command that trains it."""
        key = self.folder.keys().blocks
        stages = [self.folder.block(index) for index in range(len(self.blocks))]
        if missing := [index for index, stage in enumerate(stages) if not stage.is_done(key)]:
            raise RunError(f"{self.path}: {missing_message(missing, self.path)}")
        capture = self.scene.capture
        models = (load_verified(stage, key, index) for index, stage in enumerate(stages))
        return [Scene(model.to(torch.device(self.device)), capture) for model in models]


def open_run(
    path: str | Path,
    *,
    model: ModelName = "best",
    device: str | torch.device = "cpu",
    capture: str | Path | None = None,
) -> Run:
    """Open a run folder: `.scene`, `.capture`, `.blocks`, `.assignment`, `.block_scenes`, `.settings`.

    `model` is "coarse", "merged" or "best" (the merged one where there is one); `capture` is where the capture lies now
    if it was moved (the run remembers it). Raises RunError for a folder that is no run, VdgsError for another model
    and for a device that cannot be used.
    """
    if model not in get_args(ModelName):
        raise VdgsError(f"model={model!r}: choose one of {', '.join(get_args(ModelName))}")
    folder = RunFolder(home_path(path))
    folder.settings()
    return Run(folder, model, select_device(device).device, None if capture is None else home_path(capture))
