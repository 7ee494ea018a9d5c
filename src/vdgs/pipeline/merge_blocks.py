"""Trained blocks become one scene (end of section IV-B)."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

from rich.console import Console

from vdgs.errors import RunError
from vdgs.partition.merging import merge_blocks
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import all_block_view_indices, load_run_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import get_run_status
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.system.tensors import file_id


def merge_run_blocks(context: RunContext, allow_missing_blocks: bool, console: Console) -> None:
    """Merge the blocks of a run into RUN/merged; nothing if they are merged already.

    Raises RunError if a block is missing or failed, unless `incomplete`: the coarse anchors then stand in for it.
    """
    run = context.run
    with run.locked():
        key, keys = run.keys().merge, run.keys()
        blocks = load_run_blocks(run)
        done = [run.block(index).is_done(keys.blocks) for index in range(len(blocks))]
        models = [run.block(i).status().model_id if whole else None for i, whole in enumerate(done)]
        if run.merged.is_done(key) and run.merged.status().block_models == tuple(models):
            console.print(f"{run.merged.model}: already merged; nothing to do", highlight=False)
            return
        if not all(done) and not allow_missing_blocks:
            _refuse(run, done)
        reset_peak_memory()
        began = time.monotonic()
        opened = context.open_model("coarse")
        capture, coarse = opened.capture, opened.model
        views = capture.train_views
        cameras = [[views[i].camera for i in of_block] for of_block in all_block_view_indices(run, capture)]
        trained = [
            partial(load_verified, run.block(i), keys.blocks, i) if whole else None for i, whole in enumerate(done)
        ]
        merged, became = merge_blocks(
            coarse, trained, blocks, cameras, run.method().merge, allow_missing=allow_missing_blocks
        )
        run.merged.reset_unless(key)
        merged = replace(merged, metadata=replace(merged.metadata, key=key))
        merged.save(run.merged.model)
        trained_in = [run.block(i).status() for i, whole in enumerate(done) if whole]
        stages = [opened.status, *trained_in]
        status = StatusRecord(
            state="done", anchors=len(merged.anchors), blocks_trained=sum(done), blocks=tuple(became),
            block_models=tuple(models), model_id=file_id(run.merged.model),
            seconds=sum(each.seconds or 0.0 for each in stages),
            iterations=sum(each.iteration or 0 for each in stages),
            peak_memory_bytes=max(each.peak_memory_bytes or 0 for each in stages),
            merge_seconds=time.monotonic() - began, merge_peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip
        run.merged.set_status(status)
    console.print(
        f"merged {sum(done)} of {len(blocks)} blocks: {len(coarse.anchors):,} coarse anchors became "
        f"{len(merged.anchors):,}\nmodel: {run.merged.model}",
        highlight=False,
    )


def _refuse(run: RunFolder, done: list[bool]) -> None:
    lines = []
    standing = get_run_status(run)
    for index, whole in enumerate(done):
        if not whole:
            found = standing.of(f"block {index}")
            state = "not trained yet" if found.state in ("missing", "queued") else found.state
            lines.append(
                f"block {index}: {found.reason if state == 'stale' else state}" + _because(state, found.reason)
            )
    raise RunError(
        f"{run.path}: not all blocks are trained:\n  "
        + "\n  ".join(lines)
        + f"\nTrain them with `vdgs train-blocks {run.path}`, or give --allow-missing-blocks to let the coarse model stand in for them."
    )


def _because(state: str, why: str) -> str:
    return f" ({why})" if why and state != "stale" else ""
