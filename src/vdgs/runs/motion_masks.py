"""Masks of what moves, which a run makes after its coarse stage (`--block.mask-moving`). Its blocks train with them,
and maps take detail by them; test views are measured whole.

RUN/coarse/motion/  key, motion.json (share and mask of each training photograph, or how little moves in a sample;
                    whether that is enough for `auto`),
                    NNNNN.png (white = keep, the capture's own mask included), examples.png
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vdgs.captures.capture import Capture
from vdgs.errors import RunError
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_keys import leaves_out_motion
from vdgs.system.atomic_files import read_json_or_empty
from vdgs.system.quoting import shell_word


def has_motion_record(run: RunFolder) -> bool:
    """Whether what moves was looked for with the coarse model that is there, and the masks are complete."""
    record = read_json_or_empty(run.motion_file)
    if not _is_searched(run, record):
        return False
    masks = [each["mask"] for each in record.get("photographs", ()) if each["mask"] is not None]
    is_enough = bool(record.get("masked")) or run.settings().block.mask_moving == "auto"
    return is_enough and all(run.motion_file.with_name(mask).exists() for mask in masks)


def with_motion_masks(run: RunFolder, capture: Capture, *, needed: bool = True) -> Capture:
    """The capture with the masks of what moves in place of its own, which they include; as it is where the run leaves
    nothing out. RunError where the masks that `on` asks for are not made yet, or where `auto` does not know yet whether
    it needs them, unless they are not `needed`: then the capture as it is."""
    record, settings = read_json_or_empty(run.motion_file), run.settings()
    leaves_out = leaves_out_motion(settings, run.keys().visibility, record)
    if settings.block.mask_moving == "off" or (_is_searched(run, record) and not leaves_out):
        return capture
    if not has_motion_record(run):
        if not needed:
            return capture
        raise RunError(
            f"{run.motion_file}: the blocks need the masks of what moves, which was not looked for with this coarse "
            f"model. Look for it: vdgs visibility {shell_word(run.path)}; or train without: --block.mask-moving off"
        )
    masks = {
        each["photograph"]: run.motion_file.with_name(each["mask"])
        for each in record["photographs"]
        if each["mask"] is not None
    }
    views = [
        replace(view, mask_path=masks[view.name]) if view.split == "train" and view.name in masks else view
        for view in capture.views
    ]
    return replace(capture, views=tuple(views))


def _is_searched(run: RunFolder, record: Mapping[str, Any]) -> bool:
    """Whether a record says what moves by the coarse model that is there."""
    return record.get("key") == run.keys().visibility and "enough" in record
