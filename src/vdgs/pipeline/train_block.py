"""Block training (section IV-B): one block, from the coarse anchors of its place, with its own cameras.

The decoder is frozen, or each block trains a copy of its own. What lies around the block's core is drawn and never
moves: the margin out to its widened boundary and, as context, all else that its cameras see (choice: else every pixel
that no anchor covers would push the anchors at the boundary to fill the hole).
"""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from rich.console import Console

from vdgs import __version__
from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.image_cache import ImageCache
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import block_train_config, max_block_anchors
from vdgs.distributed.shard import Shard
from vdgs.errors import RunError
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.scale_bounds import max_log_scales
from vdgs.partition.block_regions import growth_mask, lr_ramp, split_trainable_anchors, visible_anchors
from vdgs.partition.blocks import Blocks
from vdgs.runs.open_run import block_view_indices, load_run_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.tensors import file_id
from vdgs.training import FrozenAnchors, TrainingProblem, initial_state
from vdgs.training.crops import compute_crops, load_or_compute_crops, mean_crop_area, steps_for
from vdgs.training.schedule import view_sampling_weights
from vdgs.training.session.trainer import (
    finish_stage,
    image_cache_bytes,
    resume_or_start,
    train_with_checkpoints,
    warn_without_densification,
)
from vdgs.visibility.visibility_counts import effective_sample_size


def train_block(
    context: RunContext, index: int, options: CheckpointOptions, console: Console, device: str = "cpu"
) -> None:
    """Train, or continue, one block of a run on a device; nothing if it is finished.

    Works beside other blocks of the run, in this or in other processes. Raises RunError if the run is not cut into
    blocks or has no such block, and what training raises (see `train_with_checkpoints`).
    """
    options.check()
    run = context.run
    with run.locked(shared=True):
        blocks = load_run_blocks(run)
        if not 0 <= index < len(blocks):
            raise RunError(f"{run.path}: has blocks 0 to {len(blocks) - 1}; there is no block {index}")
        folder, key = run.block(index), run.keys().blocks
        with folder.locked():
            if folder.is_done(key):
                console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
                return
            folder.reset_unless(key)
            _train(context, index, blocks, options, console, torch.device(device))


def train_shard(shard: Shard) -> None:
    """Train, or continue, a block of RUN/blocks for `vdgs train-blocks RUN`."""
    options = replace(shard.request(CheckpointOptions), image_cache_gb=shard.image_gb)
    train_block(RunContext.from_path(shard.folder.parent), shard.index, options, shard.console, shard.device)


def _train(
    context: RunContext, index: int, blocks: Blocks, options: CheckpointOptions, console: Console, device: torch.device
) -> None:
    run, opened = context.run, context.open_model("coarse", device)
    folder, method = run.block(index), run.method()
    capture, coarse = opened.capture, opened.model
    indices = block_view_indices(run, capture, index)
    views = [capture.train_views[i] for i in indices]
    cameras = [view.camera for view in views]
    metadata = ModelMetadata(
        capture=capture_metadata(capture), version=__version__, block=index, views=len(views), key=run.keys().blocks
    )
    own, around = split_trainable_anchors(coarse.anchors, blocks, index, method.block)
    around &= visible_anchors(coarse.anchors, cameras)
    anchors, surroundings = coarse.anchors.select(own), coarse.anchors.select(around)
    if not views or not len(anchors):
        _keep_coarse(folder, replace(coarse, anchors=anchors, metadata=metadata), len(views), console)
        return
    core_anchors = [block.anchors_core for block in run.partition_record().blocks]
    config = block_train_config(method, len(views))
    limit = max_block_anchors(method.block, core_anchors[index], sum(core_anchors))
    config = replace(config, densify=replace(config.densify, max_anchors=limit))
    weights = view_sampling_weights(config, anchors, cameras)
    start, crops = time.monotonic(), None
    if method.block.crop != "off":
        crops_file = folder.path / "crops.json"
        crops = load_or_compute_crops(crops_file, len(views), lambda: compute_crops(coarse, own, cameras))
    area = mean_crop_area(crops, weights) if crops else 1.0
    if method.block.crop == "fixed-pixels":
        config = replace(config, iterations=steps_for(config.iterations, area))
    preparation_seconds = time.monotonic() - start
    warn_without_densification(config, console, "--block.")
    factors = tuple(sorted({factor for _, factor in config.resolution_schedule}))
    all_cameras = [view.camera for view in capture.train_views]
    with ImageCache(views, image_cache_bytes(options), downscales=factors) as images:
        stage = TrainingProblem(
            config=config, images=images, num_images=len(views), voxel_size=coarse.voxel_size,
            camera_height=camera_height(capture), kind="block", background=coarse.background, device=device,
            frozen_decoder=method.block.decoder == "frozen", frozen_anchors=FrozenAnchors(surroundings, coarse.decoder),
            growth_mask=growth_mask(blocks, index, method.block), lr_mask=lr_ramp(blocks, index, method.block),
            image_indices=indices, view_weights=weights, crops=crops,
            max_log_scale=(
                (lambda positions: max_log_scales(positions, all_cameras)) if config.anchors.bound_scales else None
            ),
        )  # fmt: skip
        state = resume_or_start(folder, stage, lambda: initial_state(anchors, coarse.decoder.copy(), stage), console)
        state.seconds += preparation_seconds
        worth = f" (worth {effective_sample_size(weights):.0f} used alike)" if weights else ""
        parts = f", {area:.0%} of a photograph each" if crops else ""
        console.print(
            f"block {index}: {len(views)} of {len(capture.train_views)} training views{worth}, {int(own.sum()):,} "
            f"anchors of its own, {len(surroundings):,} around it, {config.iterations:,} iterations{parts}",
            highlight=False,
        )
        train_with_checkpoints(folder, state, stage, options, console)
    metadata = replace(metadata, iterations=state.iteration, decoder=method.block.decoder)
    finish_stage(folder, state, state.model(coarse.voxel_size, coarse.background, metadata), console, area)


def _keep_coarse(folder: StageFolder, model: AnchorModel, views: int, console: Console) -> None:
    """A block that cannot be trained keeps what the coarse model has there, and says why."""
    why = "no camera sees it" if not views else "it holds no anchor"
    model.save(folder.model)
    status = StatusRecord(
        state="done", iteration=0, iterations=0, anchors=len(model.anchors), seconds=0.0, reason=why,
        model_id=file_id(folder.model),
    )  # fmt: skip
    folder.set_status(status)
    console.print(f"[yellow]note[/] this block stays as the coarse model has it: {why}", highlight=False)
