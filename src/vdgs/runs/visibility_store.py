"""V of the coarse anchors of a run: counted once after the coarse stage and saved in the run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Int32, Real
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.decode_world import gaussian_means
from vdgs.runs.open_run import OpenedModel, OpenedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import read_tensors, tensors_crc32, write_tensors
from vdgs.visibility.visibility_counts import count_visibility, fade_factors

VISIBILITY_FORMAT = "vdgs-visibility-1"
VISIBILITY_FILE = "visibility.safetensors"


def get_run_visibility(opened: OpenedModel, cameras: Sequence[Camera]) -> Int32[Tensor, " n"]:
    """V_i: how many training cameras hold each anchor of the opened model in their frustum.

    `cameras` are the training cameras of the run. Read where it is saved for this coarse model, else counted, as for a
    merged model.
    """
    saved = read_visibility(opened.folder) if opened.name == "coarse" else None
    if saved is None or len(saved) != len(opened.model.anchors):
        return count_visibility(opened.model.anchors.positions, list(cameras))
    return saved.to(opened.device)


def with_fade(model: AnchorModel, cameras: Sequence[Camera], min_visibility: int) -> AnchorModel:
    """A model whose Gaussians fade out where fewer than `min_visibility` training cameras see them: nothing fixes
    depths there. It shares the tensors of the other one."""
    means = gaussian_means(model.anchors)
    factors = fade_factors(means.flatten(0, 1), cameras, min_visibility).view(means.shape[:2])
    return replace(model, anchors=replace(model.anchors, opacity_factors=factors))


def require_some_seen(visibility: Real[Tensor, " n"], min_visibility: int) -> None:
    """Raise VdgsError where no place is seen by enough cameras."""
    if (most := int(visibility.max()) if len(visibility) else 0) < min_visibility:
        raise VdgsError(f"--min-visibility {min_visibility}: leaves nothing; give at most {most}.")


def load_or_count_visibility(opened: OpenedRun) -> Int32[Tensor, " n"]:
    """As `get_run_visibility` of a run opened with its coarse model, in main memory; saved if it was not."""
    run, saved = opened.folder, read_visibility(opened.folder)
    if saved is not None and len(saved) == len(opened.model.anchors):
        return saved
    cameras = [view.camera for view in opened.capture.train_views]
    tensors = {"visibility": count_visibility(opened.model.anchors.positions, cameras).cpu()}
    header = {VISIBILITY_FORMAT: json.dumps({"key": run.keys().visibility, "crc32": tensors_crc32(tensors)})}
    write_atomic(run.visibility / VISIBILITY_FILE, lambda temporary: write_tensors(temporary, tensors, header))
    return tensors["visibility"]


def read_visibility(run: RunFolder) -> Int32[Tensor, " n"] | None:
    """V as saved for the run's coarse model; None where it is not, or is damaged: it is then counted again."""
    file = run.visibility / VISIBILITY_FILE
    if not file.exists():
        return None
    try:
        tensors, header = read_tensors(file)
        metadata = json.loads(header[VISIBILITY_FORMAT])
        is_whole = metadata["crc32"] == tensors_crc32(tensors) and tensors["visibility"].dtype == torch.int32
        return tensors["visibility"] if is_whole and metadata["key"] == run.keys().visibility else None
    except (VdgsError, KeyError, TypeError, ValueError):
        return None
