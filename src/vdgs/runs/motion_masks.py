"""Masks of what moves, which a run makes after its coarse stage (`--masks auto`). Its blocks train with them, and maps
take detail by them; test views are measured whole.

RUN/coarse/motion/  key, motion.json (share and mask of each training photograph), NNNNN.png (white = keep, the
                    capture's own mask included), examples.png
"""

from __future__ import annotations

from dataclasses import replace

from vdgs.captures.capture import Capture
from vdgs.config.capture_options import AUTO_MASKS
from vdgs.errors import RunError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder
from vdgs.system.atomic_files import read_json, read_json_or_empty
from vdgs.system.quoting import shell_word

#: The record of the masks, relative to the run, and pictures of some of them.
MOTION_FILE, MOTION_EXAMPLES = "coarse/motion/motion.json", "coarse/motion/examples.png"


def motion_folder(run: RunFolder) -> StageFolder:
    """Where the masks of a run lie."""
    return StageFolder((run.path / MOTION_FILE).parent)


def wants_motion_masks(run: RunFolder) -> bool:
    """Whether the blocks of a run train with masks of what moves."""
    return run.settings().capture.masks == AUTO_MASKS


def has_motion_masks(run: RunFolder) -> bool:
    """Whether they are complete for the coarse model that is there."""
    record, folder = read_json_or_empty(run.path / MOTION_FILE), motion_folder(run).path
    masks = [each["mask"] for each in record.get("photographs", ()) if each["mask"] is not None]
    return record.get("key") == run.keys().visibility and all((folder / mask).exists() for mask in masks)


def with_motion_masks(run: RunFolder, capture: Capture, *, needed: bool = True) -> Capture:
    """The capture with the masks of what moves in place of its own, which they include; as it is where the run wants
    none. Where they are not made yet RunError, unless they are not `needed`: then the capture as it is."""
    if not wants_motion_masks(run):
        return capture
    if not has_motion_masks(run):
        if not needed:
            return capture
        raise RunError(
            f"{run.path / MOTION_FILE}: --masks auto needs the masks of what moves, which are not made for this coarse "
            f"model. Make them: vdgs visibility {shell_word(run.path)}"
        )
    folder = motion_folder(run).path
    found = {each["photograph"]: each["mask"] for each in read_json(run.path / MOTION_FILE)["photographs"]}
    masks = {name: folder / mask for name, mask in found.items() if mask is not None}
    views = [
        replace(view, mask_path=masks[view.name]) if view.split == "train" and view.name in masks else view
        for view in capture.views
    ]
    return replace(capture, views=tuple(views))
