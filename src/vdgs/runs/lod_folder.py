"""The level-of-detail tree of a run (`vdgs lod`): where it lies, and whether it belongs to a model."""

from __future__ import annotations

import torch

from vdgs.config.commands import ModelName
from vdgs.errors import RunError
from vdgs.model.lod_format import TREE_FILE
from vdgs.model.lod_scene import LodScene
from vdgs.model.lod_tree import LodTree
from vdgs.model.renderer import Drawable
from vdgs.runs.lod_status import is_of_present_version, lod_folder
from vdgs.runs.open_run import ModelLocation, OpenedModel, locate_model, open_mapped
from vdgs.runs.run_folder import RunFolder
from vdgs.system.quoting import shell_word
from vdgs.system.tensors import file_id


def has_lod(run: RunFolder, location: ModelLocation) -> bool:
    """Whether a run has a finished tree of this very model that this version reads: by its status and a header."""
    folder = lod_folder(run)
    status = folder.status()
    of_model = status.state == "done" and status.model_id == location.stage.status().model_id
    return of_model and (folder.path / TREE_FILE).exists() and is_of_present_version(run)


def tree_id(run: RunFolder) -> str:
    """What tells the tree of a run from any other: its key, which names the model and the settings that it was made
    with, and the table of its nodes; empty where there is no finished one."""
    folder = lod_folder(run)
    table = folder.path / TREE_FILE
    return f"{folder.key()} {file_id(table)}" if table.exists() else ""


def find_tree(opened: OpenedModel) -> LodScene | None:
    """The tree of an opened model, on its device; None where there is none of this model that this version reads."""
    status = lod_folder(opened.folder).status()
    if status.state != "done" or status.model_id != opened.status.model_id or status.model_id is None:
        return None
    return open_tree(opened) if is_of_present_version(opened.folder) else None


def open_lod(run: RunFolder, which: ModelName = "best", device: str = "cpu") -> tuple[OpenedModel, LodScene]:
    """A model of a run whose anchors stay on the disk, and its tree.

    Raises RunError where the model is not trained, where it has no tree, and where the tree is of another model;
    VdgsError for a damaged one.
    """
    opened = open_mapped(run, locate_model(run, which))
    return opened, open_tree(opened, torch.device(device))


def drawn_scene(opened: OpenedModel, max_error_px: float | None, device: str = "cpu") -> Drawable:
    """The model itself, or through its tree where an error is given. Raises what `open_tree` raises."""
    return opened.model if max_error_px is None else open_tree(opened, torch.device(device)).at_error(max_error_px)


def open_tree(opened: OpenedModel, device: torch.device | None = None) -> LodScene:
    """The tree of an opened model. Raises RunError where there is none, or that of another model."""
    folder = lod_folder(opened.folder)
    again = f"Make it: vdgs lod {shell_word(opened.folder.path)}"
    again += f" --model {opened.name}" if opened.name == "coarse" else ""
    if not (folder.path / TREE_FILE).exists():
        raise RunError(f"{folder.path}: there is no finished level-of-detail tree. {again}")
    if not is_of_present_version(opened.folder):
        raise RunError(f"{folder.path}: the level-of-detail tree is of another version of vdgs. {again}")
    tree = LodTree(folder.path)
    if tree.table.model_id != opened.status.model_id:
        raise RunError(
            f"{folder.path}: is the level-of-detail tree of another model than the {opened.name} one of this run. "
            f"{again}"
        )
    return LodScene(tree, opened.model.without_anchors().to(device or opened.device))
