"""Messages about memory: the estimate before training, and advice after a failure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import psutil
from rich.console import Console

from vdgs.model.renderer import cull_anchors
from vdgs.system.memory.memory_estimate import (
    MemoryAdvice,
    TrainingKind,
    TrainingWorkload,
    decoded_image_bytes,
    describe_memory,
    estimate_memory,
    max_growth_factor,
    max_image_pixels,
    memory_advice,
    train_bytes_per_pixel,
)
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.units import data_size
from vdgs.training import TrainingProblem, TrainingState

#: Views in which the anchors are counted, evenly chosen.
MAX_COUNTED_VIEWS = 16
#: After a failure: what a remedy should save, of all that the process takes.
MIN_SAVED_FRACTION = 0.3


def training_workload(state: TrainingState, stage: TrainingProblem) -> TrainingWorkload:
    """What this training works on."""
    config, count = stage.config, stage.num_images
    cameras = [stage.images.camera(view) for view in range(count)]
    chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_COUNTED_VIEWS)).astype(int))
    anchors = state.anchors
    seen = [len(cull_anchors(anchors.with_all_levels(), cameras[view])) for view in chosen]
    photographs = decoded_image_bytes(cameras)
    growing = config.densify.num_levels > 0 and state.iteration <= config.densify.stop_fraction * config.iterations
    return TrainingWorkload(
        anchors=len(anchors),
        max_anchors=config.densify.max_anchors if growing else len(anchors),
        offsets=anchors.offsets.shape[1],
        seen=max(seen) / max(len(anchors), 1),
        pixels=max_image_pixels(cameras, config.resolution_schedule),
        pixel_bytes=train_bytes_per_pixel(config, state.decoder.envmap is not None and stage.sky_masks is not None),
        image_cache_bytes=min(photographs, getattr(stage.images, "budget_bytes", photographs)),
        surroundings=0 if stage.frozen_anchors is None else len(stage.frozen_anchors.anchors),
        has_swa=config.swa_fraction > 0,
        is_compensated=config.compensation.enabled,
        growth=max_growth_factor(config.compensation),
    )


def print_memory_estimate(need: TrainingWorkload, kind: TrainingKind, console: Console) -> None:
    """Say what training will take beside what there is; where that is too little, what helps."""
    estimate, available = estimate_memory(need), available_memory_bytes() + psutil.Process().memory_info().rss
    console.print(describe_memory(estimate, available), highlight=False)
    if (missing := estimate.total - available) > 0:
        advice = format_memory_advice(memory_advice(need, kind, missing), kind)
        warning = f"it may run out of memory: {data_size(missing)} are missing by estimate. {advice}"
        console.print(f"[yellow]warning[/] {warning}", highlight=False)


def out_of_memory_hint(need: TrainingWorkload, state: TrainingState, stage: TrainingProblem) -> str:
    """What to change after training ran out of memory, with what each change saves by estimate."""
    kind, kept = stage.kind, getattr(stage.images, "nbytes", need.image_cache_bytes)
    now = replace(
        need, anchors=len(state.anchors), max_anchors=len(state.anchors), image_cache_bytes=kept,
        has_swa=state.model_average is not None,
    )  # fmt: skip
    # Growth cannot be undone where it led, so a limit is one for training that begins anew.
    before = replace(now, anchors=min(need.anchors, len(state.anchors)))
    whole = estimate_memory(now).total
    advice = memory_advice(before, kind, round(MIN_SAVED_FRACTION * whole))
    return f"It took about {data_size(whole)}. " + format_memory_advice(advice, kind)


def format_memory_advice(found: list[MemoryAdvice], kind: TrainingKind) -> str:
    """The settings in one sentence, the most helpful first, and where each may be changed."""
    if not found:
        return "No setting would save much: this machine needs more memory."
    free = [option for option in ("--jobs", "--image-cache-gb") if any(option in each.setting for each in found)]
    others = "a new --output" if kind == "coarse" else "--overwrite"
    where = f"{' and '.join(free)} may change when a run continues, other settings need" if free else "They need"
    return f"What helps: {'; '.join(map(str, found))}. {where} {others}."
