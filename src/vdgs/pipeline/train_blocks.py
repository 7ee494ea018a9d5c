"""All blocks of a run, several at once, each in a process of its own."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from rich.console import Console

from vdgs.config.executor_options import CheckpointOptions, ExecutorOptions
from vdgs.distributed.job_labels import BLOCK_LABELS
from vdgs.distributed.node_check import NodeRequirements, image_and_mask_files
from vdgs.distributed.sharded_job import ExecutionOptions, ShardedJob, ShardNeeds
from vdgs.errors import RunError, VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import has_envmap
from vdgs.runs.motion_masks import with_motion_masks
from vdgs.runs.open_run import load_run_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.memory.memory_estimate import block_workload, decoded_image_bytes, estimate_memory, max_image_pixels


def train_blocks(
    context: RunContext,
    options: CheckpointOptions,
    jobs: int,
    console: Console,
    device: str = "cpu",
    executor_options: ExecutorOptions | None = None,
) -> None:
    """Train, or continue, all blocks of a run that are not finished, on this machine or by another executor.

    `jobs` at once, each on `device`; 0 takes as many as there is room for. Raises RunError if a block failed (the
    others are trained first), Stopped after Ctrl-C or SIGTERM (every block saved), and VdgsError where a machine of a
    cluster cannot work on the run, before anything starts.
    """
    options.check()
    if jobs < 0:
        raise VdgsError(f"--jobs is {jobs}; it must be at least 1, or 0 for what cores and memory allow")
    # Not resolved: other machines may mount what links point to elsewhere.
    run = RunFolder(Path(os.path.abspath(context.run.path)))
    start = time.monotonic()
    with run.locked(shared=True):
        blocks, key = load_run_blocks(run), run.keys().blocks
        _remove_beyond(run, len(blocks), console)
        pending = [index for index in range(len(blocks)) if not run.block(index).needs_no_work(key)]
        if not pending:
            console.print(f"{context.run.path}/blocks: all {len(blocks)} trained; nothing to do", highlight=False)
            return
        context.release_models()  # the memory is for the blocks
        views = with_motion_masks(run, context.capture).train_views
        cameras = [view.camera for view in views]
        records = [run.motion_file] if run.motion_file.exists() else []  # decides on keys and masks
        files = [run.config_file, run.coarse.model, *records, *image_and_mask_files(views)]
        job = ShardedJob(
            worker="block", request=options, folder=run.path / "blocks", kind=BLOCK_LABELS,
            spans=tuple(range(index, index + 1) for index in range(len(blocks))),
        )  # fmt: skip
        needs = ShardNeeds(
            _block_bytes(run, cameras, has_envmap(run.coarse.model)),
            lambda: NodeRequirements(run.path, files),
            decoded_image_bytes(cameras),
        )

        def on_ready() -> None:
            _note_discarded(run, pending, key, console)
            for index in pending:
                _mark_queued(run.block(index), key)

        execution = ExecutionOptions(executor_options or ExecutorOptions(), jobs, options.image_cache_gb, device)
        job.send(pending, len(blocks), needs, execution, console, on_ready)
    console.print(f"blocks trained in {(time.monotonic() - start) / 60:.1f} min", highlight=False)


def _note_discarded(run: RunFolder, pending: list[int], key: str, console: Console) -> None:
    """Name the blocks that were trained for another partition or with other settings: their models are deleted."""
    old = [index for index in pending if run.block(index).has_output() and run.block(index).key() != key]
    if old:
        console.print(
            f"[yellow]note[/] trained for another cut or with other settings, and trained again: block"
            f"{'s' if len(old) > 1 else ''} {', '.join(map(str, old))}",
            highlight=False,
        )


def _mark_queued(folder: StageFolder, key: str) -> None:
    """Set the status of a block to queued, and delete work of other settings; not if another process trains it."""
    with suppress(RunError), folder.locked():
        folder.reset_unless(key)
        if not folder.needs_no_work(key):
            folder.set_status(StatusRecord(state="queued"))


def _remove_beyond(run: RunFolder, count: int, console: Console) -> None:
    """Delete blocks of an earlier partition into more of them."""
    for folder in run.block_folders():
        if int(folder.path.name) >= count:
            console.print(f"[yellow]note[/] {folder.path} is of an earlier cut and is deleted", highlight=False)
            shutil.rmtree(folder.path)


def _block_bytes(run: RunFolder, cameras: Sequence[Camera], has_sky: bool = False) -> int:
    """Memory by estimate that the largest block needs for the program, its image, its anchors once they have grown, and
    those around it; `has_sky`: before an environment map. Cached images have a budget of their own."""
    method, anchors = run.method(), [each.anchors_core for each in run.partition_record().blocks]
    pixels = max_image_pixels(cameras, method.block.resolution_schedule)
    return estimate_memory(block_workload(method, max(anchors), sum(anchors), pixels, has_sky)).total
