"""Whether the model in a stage's folder is the one that the stage made, and not a file that a person copied there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from vdgs.errors import RunError
from vdgs.model.model_metadata import read_model_metadata
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.permissions import refusal

if TYPE_CHECKING:
    from pathlib import Path

    from vdgs.model.anchor_model import AnchorModel

MODEL_MISMATCH = "not the model that status.json beside it speaks of"


def integrity_error(stage: StageFolder, key: str, block: int | None = None) -> str:
    """What the model of a finished stage is instead of its own; empty where it may be that.

    By the header and the size of the file alone, which cost nothing. Raises OSError where the system does not let it be
    read, which says nothing of it.
    """
    try:
        metadata = read_model_metadata(stage.model)
    except (ValueError, KeyError, TypeError, AttributeError):
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

    Raises RunError for a file that the stage did not make, however it came there, and for one that the system does not
    let be read; VdgsError for one that is damaged.
    """
    from vdgs.model.anchor_model import AnchorModel
    from vdgs.system.tensors import file_id

    with _reading(stage):
        error = integrity_error(stage, key, block)
        model = AnchorModel.load(stage.model)
        if not error and stage.status().model_id not in (None, file_id(stage.model)):
            error = MODEL_MISMATCH
        _refuse(stage, error)
    return model


def map_verified(stage: StageFolder, key: str) -> AnchorModel:
    """The model of a finished stage, whose numbers stay in its file until they are used: only its header and its size
    are checked. Raises as `load_verified`."""
    from vdgs.model.anchor_model import AnchorModel

    with _reading(stage):
        _refuse(stage, integrity_error(stage, key))
        return AnchorModel.load(stage.model, checked=False)


@contextmanager
def _reading(stage: StageFolder) -> Iterator[None]:
    """Raise RunError where the system does not let the model be read: nothing then says that it is a wrong one."""
    try:
        yield
    except FileNotFoundError as error:
        raise RunError(f"{stage.model}: is not there. Put it back, or give the command that made it again.") from error
    except OSError as error:
        raise RunError(f"{unreadable_text(stage, error)}, then give the command again.") from error


def unreadable_text(stage: StageFolder, error: OSError) -> str:
    """What to say where the system does not let a model be read; without a full stop."""
    return f"{stage.model}: {refusal(stage.model, error)}"


def _refuse(stage: StageFolder, error: str) -> None:
    if error:
        raise RunError(
            f"{stage.model}: is {error}. Put back the one that was trained here, or delete {path_to_delete(stage)} and "
            "give the command that made it again."
        )
