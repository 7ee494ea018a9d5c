"""Trained blocks become one scene (end of section IV-B)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from rich.console import Console

from vdgs.config.method import MethodConfig
from vdgs.errors import RunError
from vdgs.model.anchor_model import AnchorModel
from vdgs.partition.merging import merge_blocks
from vdgs.runs.model_integrity import load_verified
from vdgs.runs.open_run import OpenedRun, all_block_cameras, load_run_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import get_run_status
from vdgs.runs.stage_folder import StatusRecord
from vdgs.system.console import show_share
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.system.quoting import shell_word
from vdgs.system.tensors import file_id
from vdgs.training.exposure_centering import with_local_exposure


def merge_run_blocks(context: RunContext, allow_missing_blocks: bool, console: Console) -> None:
    """Merge the blocks of a run into RUN/merged; nothing if they are merged already.

    Raises RunError if a block is missing or failed, even where an earlier merge did without it, unless
    `allow_missing_blocks`: the coarse anchors then stand in. Who drives the run waits for others that train its blocks
    (`vdgs train-blocks`); else RunError where another process works on it.
    """
    run = context.run

    def say_who_is_waited_for() -> None:
        console.print(f"{run.path}: another vdgs process works on its blocks; waiting for it", highlight=False)

    with run.locked(on_wait=say_who_is_waited_for if run.is_driven_here() else None):
        keys, blocks = run.keys(), load_run_blocks(run)
        folders = [run.block(index) for index in range(len(blocks))]
        done = [folder.needs_no_work(keys.blocks) for folder in folders]
        models = [folder.status().model_id if is_done else None for folder, is_done in zip(folders, done, strict=True)]
        if not all(done) and not allow_missing_blocks:
            raise RunError(_missing_blocks_text(run, done))
        if run.merged.needs_no_work(keys.merge) and run.merged.status().block_models == tuple(models):
            console.print(f"{run.merged.model}: already merged; nothing to do", highlight=False)
            return
        reset_peak_memory()
        start = time.monotonic()
        opened = context.open_model("coarse")
        coarse = _with_reference_exposure(opened, run.method(), console)
        cameras = all_block_cameras(run, opened.capture)
        trained = [
            partial(load_verified, folder, keys.blocks, index) if done[index] else None
            for index, folder in enumerate(folders)
        ]
        merged, merged_blocks = merge_blocks(
            coarse, trained, blocks, cameras, run.method().merge, allow_missing=allow_missing_blocks
        )
        run.merged.reset_unless(keys.merge)
        merged = replace(merged, metadata=replace(merged.metadata, key=keys.merge))
        merged.save(run.merged.model)
        stages = [opened.status, *(folder.status() for folder, is_done in zip(folders, done, strict=True) if is_done)]
        status = replace(
            _of_stages(stages), anchors=len(merged.anchors), blocks_trained=sum(done), blocks=tuple(merged_blocks),
            block_models=tuple(models), model_id=file_id(run.merged.model),
            merge_seconds=time.monotonic() - start, merge_peak_memory_bytes=peak_memory_bytes(),
        )  # fmt: skip
        run.merged.set_status(status)
    console.print(
        f"merged {sum(done)} of {len(blocks)} blocks: {len(coarse.anchors):,} coarse anchors became "
        f"{len(merged.anchors):,}\nmodel: {run.merged.model}",
        highlight=False,
    )


def _with_reference_exposure(opened: OpenedRun, method: MethodConfig, console: Console) -> AnchorModel:
    """The coarse model, with the exposure of each place where the merged one has it and a coarse model of another
    version may not."""
    if method.merge.reference_exposure != "local":
        return opened.model
    with show_share(console, "colors of the photographs") as on_progress:
        return with_local_exposure(opened.model, [view.camera for view in opened.capture.train_views], on_progress)


def _of_stages(stages: Sequence[StatusRecord]) -> StatusRecord:
    """What a merged model took: the sums of its stages, and the memory of the largest."""
    return StatusRecord(
        state="done",
        seconds=sum(each.seconds or 0.0 for each in stages),
        iterations=sum(each.iteration or 0 for each in stages),
        peak_memory_bytes=max(each.peak_memory_bytes or 0 for each in stages),
    )


def _missing_blocks_text(run: RunFolder, done: list[bool]) -> str:
    lines, run_status = [], get_run_status(run)
    for index in (index for index, is_done in enumerate(done) if not is_done):
        block = run_status.of(f"block {index}")
        state = "not trained yet" if block.state in ("missing", "queued") else block.state
        text = state + (f" ({block.reason})" if block.reason else "")
        lines.append(f"block {index}: {block.reason if state == 'stale' else text}")
    return (
        f"{run.path}: not all blocks are trained:\n  "
        + "\n  ".join(lines)
        + f"\nTrain them with: vdgs train-blocks {shell_word(run.path)}\nor give --allow-missing-blocks to let the "
        "coarse model stand in for them."
    )
