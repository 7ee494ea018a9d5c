"""V of the coarse anchors of a run: counted once after the coarse stage, kept in the run, read by all that need it."""

from __future__ import annotations

import json
from collections.abc import Sequence

import torch
from jaxtyping import Int32
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.runs.open_run import OpenedModel, OpenedRun
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import write_atomic
from vdgs.system.tensors import read_tensors, tensors_crc32, write_tensors
from vdgs.visibility.visibility_counts import count_visibility

VISIBILITY_FORMAT = "vdgs-visibility-1"
VISIBILITY_FILE = "visibility.safetensors"


def get_run_visibility(opened: OpenedModel, cameras: Sequence[Camera]) -> Int32[Tensor, " n"]:
    """V_i: how many training cameras hold each anchor of the opened model in their frustum.

    `cameras` are the training cameras of the run. Of the coarse model as it is kept; counted where it is not there, or
    not that of this model. The anchors of a merged model are others: theirs is counted.
    """
    kept = _read(opened.folder) if opened.name == "coarse" else None
    if kept is None or len(kept) != len(opened.model.anchors):
        return count_visibility(opened.model.anchors.positions, list(cameras))
    return kept.to(opened.device)


def load_or_count_visibility(opened: OpenedRun) -> Int32[Tensor, " n"]:
    """As `get_run_visibility` of a run opened with its coarse model, in main memory, and kept from now on."""
    cameras = [view.camera for view in opened.capture.train_views]
    kept = _read(opened.folder)
    if kept is not None and len(kept) == len(opened.model.anchors):
        return kept
    tensors = {"visibility": count_visibility(opened.model.anchors.positions, cameras).cpu()}
    facts = {"key": opened.folder.keys().visibility, "crc32": tensors_crc32(tensors)}
    header = {VISIBILITY_FORMAT: json.dumps(facts)}
    write_atomic(
        opened.folder.visibility / VISIBILITY_FILE, lambda temporary: write_tensors(temporary, tensors, header)
    )
    return tensors["visibility"]


def _read(run: RunFolder) -> Int32[Tensor, " n"] | None:
    """What is kept for the run's coarse model; None where nothing is, or it is damaged: it is then counted again."""
    file = run.visibility / VISIBILITY_FILE
    if not file.exists():
        return None
    try:
        tensors, header = read_tensors(file)
        facts = json.loads(header[VISIBILITY_FORMAT])
        whole = facts["crc32"] == tensors_crc32(tensors) and tensors["visibility"].dtype == torch.int32
        return tensors["visibility"] if whole and facts["key"] == run.keys().visibility else None
    except (VdgsError, KeyError, TypeError, ValueError):
        return None
