"""What people are told about memory: before training how much it will take, after a failure what takes less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import psutil
from rich.console import Console

from vdgs.model.renderer import visible_rows
from vdgs.system.memory.memory_estimate import (
    Advice,
    Kind,
    Need,
    advice,
    decoded_bytes,
    describe,
    estimate,
    largest_picture,
    most_growth,
)
from vdgs.system.memory.process_memory import available_bytes
from vdgs.system.units import data_size
from vdgs.training import Stage, TrainingState

#: Views in which the anchors are counted, evenly chosen.
VIEWS_COUNTED = 16
#: After a failure: what a remedy should save, of all that the process takes.
SAVE_SHARE = 0.3


def need_of(state: TrainingState, stage: Stage) -> Need:
    """What this training works on."""
    config, count = stage.config, stage.image_count
    cameras = [stage.images.camera(view) for view in range(count)]
    chosen = np.unique(np.linspace(0, count - 1, min(count, VIEWS_COUNTED)).astype(int))
    anchors = state.anchors
    seen = [len(visible_rows(anchors, cameras[view])) for view in chosen]
    photographs = decoded_bytes(cameras)
    growing = config.growth.levels > 0 and state.iteration <= config.growth.until * config.iterations
    return Need(
        anchors=len(anchors),
        max_anchors=config.growth.max_anchors if growing else len(anchors),
        offsets=anchors.offsets.shape[1],
        seen=max(seen) / max(len(anchors), 1),
        pixels=largest_picture(cameras, config.resolutions),
        images_bytes=min(photographs, getattr(stage.images, "budget_bytes", photographs)),
        surroundings=0 if stage.surroundings is None else len(stage.surroundings.anchors),
        averaged=config.average > 0,
        growth=most_growth(config.compensation),
    )


def announce(need: Need, kind: Kind, console: Console) -> None:
    """Say what training will take beside what there is; where that is too little, what helps."""
    found = estimate(need)
    room = available_bytes() + psutil.Process().memory_info().rss
    console.print(describe(found, room), highlight=False)
    if found.total > room:
        helpful = advice(need, kind, found.total - room)
        console.print(
            f"[yellow]warning[/] it may run out of memory: {data_size(found.total - room)} are missing by estimate. "
            + what_helps(helpful, kind),
            highlight=False,
        )


def after_failure(need: Need, state: TrainingState, stage: Stage) -> str:
    """What to change after training ran out of memory, with what each change saves by estimate."""
    kind, kept = stage.kind, getattr(stage.images, "nbytes", need.images_bytes)
    now = replace(
        need, anchors=len(state.anchors), max_anchors=len(state.anchors), images_bytes=kept,
        averaged=state.average is not None,
    )  # fmt: skip
    # Growth cannot be undone where it led, so a limit is one for training that begins anew.
    before = replace(now, anchors=min(need.anchors, len(state.anchors)))
    whole = estimate(now).total
    return f"It took about {data_size(whole)}. " + what_helps(advice(before, kind, round(SAVE_SHARE * whole)), kind)


def what_helps(found: list[Advice], kind: Kind) -> str:
    """The settings in one sentence, the most helpful first, and where each may be changed."""
    if not found:
        return "No setting would save much: this machine needs more memory."
    free = [option for option in ("--jobs", "--image-memory-gb") if any(option in each.setting for each in found)]
    others = "a new --output" if kind == "coarse" else "--redo"
    where = f"{' and '.join(free)} may change when a run continues, other settings need" if free else "They need"
    return f"What helps: {'; '.join(map(str, found))}. {where} {others}."
