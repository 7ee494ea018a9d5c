"""Whether the model in a stage's folder is the one that the stage made, and not a file that a person copied there."""

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
        content = json.loads(header.get(ANCHOR_MODEL_FORMAT) or header[MULTI_DECODER_FORMAT])
        metadata = ModelMetadata.from_dict(content["facts"])
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError):
        return "not a model that can be read"
    if metadata.block != block:
        return "a model of the whole scene" if metadata.block is None else f"the model of block {metadata.block}"
    if metadata.key != key:
        return "a model of other settings or of another run"
    return "" if _size_agrees(stage) else MODEL_MISMATCH


def path_to_delete(stage: StageFolder) -> Path:
    """What to delete where the model is foreign: all of the stage if it came as a whole, checkpoints and all, else the
    model alone, which is then rebuilt from the last checkpoint."""
    return stage.path if stage.status().model_id is not None and _size_agrees(stage) else stage.model


def _size_agrees(stage: StageFolder) -> bool:
    model_id = stage.status().model_id
    return model_id is None or model_id.startswith(f"{stage.model.stat().st_size}-")


def load_verified(stage: StageFolder, key: str, block: int | None = None) -> AnchorModel:
    """The model of a finished stage, of these settings and of this block.

    Raises RunError for a file that the stage did not make, however it came there; VdgsError for one that is damaged.
    """
    model = AnchorModel.load(stage.model)
    error = integrity_error(stage, key, block)
    if not error and stage.status().model_id not in (None, file_id(stage.model)):
        error = MODEL_MISMATCH
    if error:
        raise RunError(
            f"{stage.model}: is {error}. Put back the one that was trained here, or delete {path_to_delete(stage)} and "
            "give the command that made it again."
        )
    return model
