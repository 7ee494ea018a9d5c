"""Whether the model in a stage's folder is the one that the stage made: people copy files, also to where they do not
belong."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import SafetensorError, safe_open

from vdgs.errors import RunError
from vdgs.model.anchor_model import ANCHOR_MODEL_FORMAT, MULTI_DECODER_FORMAT, AnchorModel, ModelMetadata
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.tensors import file_id

MODEL_MISMATCH = "not the model that status.json beside it speaks of"


def integrity_error(stage: StageFolder, key: str, block: int | None = None) -> str:
    """What the model of a finished stage is instead of its own; empty where it may be that.

    By the header and the size of the file alone, which cost nothing.
    """
    try:
        with safe_open(stage.model, framework="pt") as file:
            header = dict(file.metadata() or {})
        told = ModelMetadata.from_dict(
            json.loads(header.get(ANCHOR_MODEL_FORMAT) or header[MULTI_DECODER_FORMAT])["facts"]
        )
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError):
        return "not a model that can be read"
    if told.block != block:
        return "a model of the whole scene" if told.block is None else f"the model of block {told.block}"
    if told.key != key:
        return "a model of other settings or of another run"
    return "" if _size_agrees(stage) else MODEL_MISMATCH


def path_to_delete(stage: StageFolder) -> Path:
    """What to delete where the model is foreign: all of the stage if it came as a whole, checkpoints and all, else the
    model alone, which is then rebuilt from the last checkpoint."""
    return stage.path if stage.status().model_id is not None and _size_agrees(stage) else stage.model


def _size_agrees(stage: StageFolder) -> bool:
    vouched = stage.status().model_id
    return vouched is None or vouched.startswith(f"{stage.model.stat().st_size}-")


def load_verified(stage: StageFolder, key: str, block: int | None = None) -> AnchorModel:
    """The model of a finished stage, of these settings and of this block.

    Raises RunError for a file that the stage did not make, however it came there; VdgsError for one that is damaged.
    """
    model = AnchorModel.load(stage.model)
    wrong = integrity_error(stage, key, block)
    if not wrong and stage.status().model_id not in (None, file_id(stage.model)):
        wrong = MODEL_MISMATCH
    if wrong:
        raise RunError(
            f"{stage.model}: is {wrong}. Put back the one that was trained here, or delete {path_to_delete(stage)} and give "
            "the command that made it again."
        )
    return model
