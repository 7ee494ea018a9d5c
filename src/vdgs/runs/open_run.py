"""A run opened to look at it or to build on it: its capture, and one of its models."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.loading import load_capture
from vdgs.config.commands import ModelName
from vdgs.errors import CaptureError, RunError
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.assignment.assign_cameras import Assignment
from vdgs.partition.assignment.score_file import load_scores
from vdgs.partition.blocks import Blocks, load_blocks, xy_positions
from vdgs.partition.merging import BlockLookup, block_of_points
from vdgs.runs.model_integrity import load_verified, map_verified
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStatus, get_run_status
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import read_json
from vdgs.system.quoting import shell_word


@dataclass(frozen=True, kw_only=True)
class OpenedModel:
    """One of the models of a run."""

    folder: RunFolder
    model: AnchorModel
    model_path: Path
    #: Which model it is, "coarse" or "merged", and the status of the stage that made it.
    name: str
    status: StatusRecord
    #: Of the settings that it was made with (`runs.stage_keys`).
    key: str
    #: Why it is not the model that one would expect (no merged one, or one that is out of date); empty where it is.
    warning: str
    #: The blocks that coarse anchors stand in for; None for a model that is not put together from blocks.
    missing_blocks: tuple[int, ...] | None = None

    @property
    def summary(self) -> str:
        """Which model it is, in a few words."""
        return _model_summary(self.name, len(self.model.anchors), self.model_path)

    @property
    def device(self) -> torch.device:
        """Where the model is."""
        return self.model.anchors.positions.device


@dataclass(frozen=True, kw_only=True)
class OpenedRun(OpenedModel):
    """An opened model and the capture as it was trained on."""

    capture: Capture


def open_run(path: Path, which: ModelName = "best", device: torch.device | str = "cpu") -> OpenedRun:
    """Open a run, its model on a device.

    Raises RunError if it is none or not trained, CaptureError if its photographs are gone.
    """
    folder = RunFolder(path)
    capture = open_capture(folder)
    return with_capture(open_model(folder, which, device), capture)


def with_capture(opened: OpenedModel, capture: Capture) -> OpenedRun:
    """An opened model and the capture of its run. Raises RunError where it was made from another one."""
    check_same_capture(opened.model_path, opened.model.metadata.capture, capture)
    return OpenedRun(**vars(opened), capture=capture)


def open_model(folder: RunFolder, which: ModelName = "best", device: torch.device | str = "cpu") -> OpenedModel:
    """Open a model of a run on a device, without the capture. Raises RunError if it is not trained."""
    location = locate_model(folder, which)
    return location.opened(folder, load_verified(location.stage, location.key).to(torch.device(device)))


def open_mapped(folder: RunFolder, location: ModelLocation) -> OpenedModel:
    """A model of a run whose anchors stay on the disk until they are used. Raises what `map_verified` raises."""
    return location.opened(folder, map_verified(location.stage, location.key))


def check_has_anchors(folder: RunFolder, anchors: int | None) -> None:
    """Raise RunError where the coarse model of a run holds no anchors (None: not known): nothing can be built on it."""
    if anchors == 0:
        growth = folder.method().training.densify
        raise RunError(
            f"{folder.coarse.path}: the coarse model holds no anchors: in training all of them were taken for "
            f"transparent and removed. Give a smaller --densify.prune-opacity (it is {growth.prune_opacity:g}) or a "
            "larger --densify.start, to `vdgs run --overwrite` or in another run, and look at the photographs "
            "with `vdgs inspect`: do they show the place, through the right cameras?"
        )


@dataclass(frozen=True)
class ModelLocation:
    """One of the models of a run, not read yet; as `OpenedModel`."""

    stage: StageFolder
    name: ModelName
    key: str
    warning: str

    @property
    def summary(self) -> str:
        """Which model it is, in a few words."""
        return _model_summary(self.name, self.stage.status().anchors or 0, self.stage.model)

    def opened(self, folder: RunFolder, model: AnchorModel) -> OpenedModel:
        """The same with the model that was read of it."""
        status = self.stage.status()
        missing = tuple(index for index, block in enumerate(status.block_models or ()) if block is None)
        return OpenedModel(
            folder=folder, model=model, model_path=self.stage.model, name=self.name, status=status, key=self.key,
            warning=self.warning, missing_blocks=missing if self.name == "merged" else None,
        )  # fmt: skip


def _model_summary(name: str, anchors: int, file: Path) -> str:
    size = f", {file.stat().st_size / 1e6:,.1f} MB" if file.is_file() else ""  # a scene in memory has none
    return f"{name} model ({anchors:,} anchors{size})"


def locate_model(folder: RunFolder, which: ModelName = "best") -> ModelLocation:
    """Which model of a run is meant. Raises RunError if it is not trained."""
    keys, name = folder.keys(), which
    if which == "best":
        name = "merged" if folder.merged.is_done(keys.merge) else "coarse"
    stage, key = (folder.merged, keys.merge) if name == "merged" else (folder.coarse, keys.coarse)
    if not stage.is_done(key):
        raise RunError(_missing_model_text(folder, name))
    return ModelLocation(stage, name, key, _warning(folder, name) if which != "coarse" else "")


def _missing_model_text(folder: RunFolder, name: str) -> str:
    """Why a model cannot be opened, and what to do."""
    run_status = get_run_status(folder)
    stage = run_status.of("merge" if name == "merged" else "coarse")
    why = f"state: {stage.state}" + (f", {stage.reason}" if stage.reason else "")
    return f"{folder.path}: has no {name} model of its settings yet ({why}). {_next_text(run_status)}"


def _next_text(run_status: RunStatus) -> str:
    """What to do next about a run that is not finished."""
    if command := run_status.next_command():
        return f"Next: {command}"
    return f"To mend: {run_status.problem}" if run_status.problem else "A process works on it: wait for it."


def _warning(folder: RunFolder, name: str) -> str:
    """The warning for a model that is not the merged one, or for a merged one that is out of date."""
    run_status = get_run_status(folder)
    merged = run_status.of("merge")
    if merged.state == "done":
        return merged.reason
    if merged.problem:
        return f"the merged model cannot be read, and may be as it should be. To mend: {merged.problem}"
    if name == "merged":
        return f"the merged model is out of date: {merged.reason}. Merge again: vdgs merge {shell_word(folder.path)}"
    state = f"there is one that was {merged.reason}" if merged.state == "stale" else "there is none yet"
    return f"this is the coarse model, not the merged one: {state}. {_next_text(run_status)}"


def open_capture(folder: RunFolder, at: Path | None = None) -> Capture:
    """The capture of a run, read as the run was started; `at` is where it lies if not where it lay.

    Raises CaptureError if it is gone or changed its form.
    """
    settings = folder.settings() if at is None else folder.settings().moved(at)
    if at is None and (why := folder.missing_capture()):
        raise CaptureError(why)
    return load_capture(Path(settings.capture_path), settings.capture)


def relocate_capture(folder: RunFolder, at: Path) -> Capture:
    """Let a run find its capture where it lies now; returns it. Raises RunError for another capture than the run's, and
    where another process works on the run or drives it."""
    capture = open_capture(folder, at.resolve())
    with folder.drive_lock(), folder.locked():
        if folder.capture_file.exists():
            check_same_capture(folder.capture_file, read_json(folder.capture_file), capture)
        folder.move_capture(at)
    return capture


def load_run_blocks(run: RunFolder) -> Blocks:
    """The blocks of a run, with cameras. Raises RunError unless they were made with the run's settings."""
    record, keys = run.partition_record(), run.keys()
    if (record.key, record.assignment_key) != (keys.partition, keys.assignment):
        raise RunError(
            f"{run.path}: is not cut into blocks yet, or with other settings. Run: "
            f"vdgs partition {shell_word(run.path)}"
        )
    return load_blocks(run.partition / "blocks.geojson")


def load_run_assignment(run: RunFolder) -> Assignment:
    """Which training views serve which block, and why. Raises what `load_run_blocks` raises."""
    load_run_blocks(run)
    return load_scores(run.partition / "scores.npz")[2]


def block_view_indices(run: RunFolder, capture: Capture, index: int) -> list[int]:
    """The indices of the training views that serve a block."""
    return all_block_view_indices(run, capture)[index]


def all_block_view_indices(run: RunFolder, capture: Capture) -> list[list[int]]:
    """The same of every block. Raises RunError where the assignment is of another capture."""
    file = run.partition / "scores.npz"
    _, _, assignment = load_scores(file)
    if len(assignment.cameras) != len(capture.train_views):
        raise RunError(f"{file}: is of another capture. Run: vdgs partition {shell_word(run.path)}")
    return [np.flatnonzero(of_block).tolist() for of_block in assignment.cameras.T]


def all_block_cameras(run: RunFolder, capture: Capture) -> list[list[Camera]]:
    """The cameras of the training views that serve each block. Raises what `all_block_view_indices` raises."""
    views = capture.train_views
    return [[views[index].camera for index in indices] for indices in all_block_view_indices(run, capture)]


def block_lookup(opened: OpenedRun, blocks: Blocks) -> BlockLookup:
    """Says which block of a run's cut an opened model has its anchors from at a point: by the rule that it was merged
    by, and by owner for a model that is not put together from blocks. Raises what `all_block_view_indices` raises."""
    if opened.missing_blocks is None or (config := opened.folder.method().merge).rule == "owner":
        return lambda positions: blocks.owner(xy_positions(positions))
    return partial(
        block_of_points, blocks=blocks, cameras_of_block=all_block_cameras(opened.folder, opened.capture),
        config=config, missing=opened.missing_blocks,
    )  # fmt: skip
