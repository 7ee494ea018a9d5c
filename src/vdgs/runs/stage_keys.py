"""Which settings each stage of a run depends on, so that a change invalidates exactly what depends on it.

Every stage has a key: a digest of its own settings and of the keys of the stages before it. A finished stage is
skipped while its key is the one that it was finished with.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vdgs.runs.run_settings import RunSettings

#: Each stage with the sections of config.yaml that it depends on and the stages it builds on.
STAGE_DEPENDENCIES: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "coarse": (("capture", "training"), ()),
    "visibility": ((), ("coarse",)),
    "partition": (("partition",), ("visibility",)),
    "assignment": (("assignment",), ("partition",)),
    "blocks": (("block",), ("assignment",)),
    "merge": (("merge",), ("blocks",)),
}
#: Settings that do nothing without another.
REQUIRED_SETTINGS: dict[tuple[str, ...], str] = {("training", "exposure_min_spread"): "exposure_compensation"}


@dataclass(frozen=True, kw_only=True)
class StageKeys:
    """The key of every stage of a run."""

    coarse: str
    visibility: str
    partition: str
    assignment: str
    blocks: str
    merge: str


def stage_keys(
    settings: RunSettings,
    coarse_model: str | None = None,
    motion: Mapping[str, Any] | None = None,
) -> StageKeys:
    """Keys from the sections of config.yaml. What builds on the coarse stage also depends on the very model
    (`coarse_model`): trained again on another machine it may differ in its last bits. `motion` is the record of what
    moves (`runs.motion_masks`), which says whether the blocks leave it out where the settings do not."""
    # Where the capture lies is not what it is: a capture that moved keeps its results.
    keys, plain = dict[str, str](), settings.moved(Path()).to_dict()
    for stage, (sections, before) in STAGE_DEPENDENCIES.items():
        own: dict[str, Any] = {name: hashable_settings(name, plain[name]) for name in sections}
        if stage == "blocks":  # what is asked counts by what it does
            del own["block"]["mask_moving"]
            own |= {"masks": "auto"} if leaves_out_motion(settings, keys["visibility"], motion or {}) else {}
        if stage == "merge" and not settings.training.exposure_compensation:
            del own["merge"]["reference_exposure"]  # there is none, and runs of before stay as they are
        if stage == "partition" and settings.partition.blocks == "auto":
            own["block_count"] = _block_count_settings(settings)
        content = [own, *(keys[name] for name in before), *([coarse_model] if before == ("coarse",) else [])]
        keys[stage] = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
    return StageKeys(**keys)


def _block_count_settings(settings: RunSettings) -> dict[str, Any]:
    """What the number of blocks follows from with `--blocks auto`, of the settings of blocks: what makes their training
    take more memory (`memory_estimate.block_workload`)."""
    block, compensation = settings.block, settings.block.compensation
    return {
        "is_margin_trained": block.margin != "frozen",
        "max_anchors": [block.densify.max_anchors, block.max_anchors_total],
        "has_swa": block.swa_fraction > 0,
        "is_compensated": compensation.enabled,
        "has_fixed_threshold": compensation.enabled and not compensation.t_low_quantile,
        "downscale": min(factor for _, factor in block.resolution_schedule),
    }


def leaves_out_motion(settings: RunSettings, visibility_key: str, motion: Mapping[str, Any]) -> bool:
    """Whether the blocks are trained with masks of what moves: with `auto`, where a sample of the record has enough."""
    asked = settings.block.mask_moving
    return asked == "on" or (asked == "auto" and motion.get("key") == visibility_key and moves_enough(motion))


def moves_enough(motion: Mapping[str, Any]) -> bool:
    """Whether `auto` masks what moves by this record, which `on` may have asked for."""
    return bool(motion.get("enough"))


def hashable_settings(section: str, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings of a section that keys are made of: one that needs another counts only beside it."""
    ignored = {("capture", "path"), *(each for each, needed in REQUIRED_SETTINGS.items() if not settings.get(needed))}
    return {name: value for name, value in settings.items() if (section, name) not in ignored}
