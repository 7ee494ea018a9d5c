"""Block training (section IV-B): one block, from the coarse anchors of its place, with its own cameras.

The decoder is frozen, or each block trains a copy of its own. What lies around the block's core is drawn and never
moves: the margin out to its widened boundary and, as context, all else that its cameras see (choice: else every pixel
that no anchor covers would push the anchors at the boundary to fill the hole).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from rich.console import Console

from vdgs import __version__
from vdgs.captures.camera_height import camera_height, offset_rate_factor
from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.image_cache import ImageCache
from vdgs.config.executor_options import CheckpointOptions
from vdgs.config.method import MethodConfig, TrainConfig, block_train_config, max_block_anchors
from vdgs.distributed.shard import Shard
from vdgs.errors import RunError
from vdgs.model.anchor_model import AnchorModel, ModelMetadata
from vdgs.model.anchors import Anchors
from vdgs.model.initialization.sky_masks import SkyMask
from vdgs.model.levels import level_sizes
from vdgs.model.scale_bounds import max_log_scales
from vdgs.partition.block_regions import growth_mask, lr_ramp, split_trainable_anchors, visible_anchors
from vdgs.partition.blocks import Blocks, xy_positions
from vdgs.runs.motion_masks import with_motion_masks
from vdgs.runs.open_run import block_view_indices, load_run_blocks
from vdgs.runs.run_context import RunContext
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.tensors import file_id
from vdgs.training import FrozenAnchors, TrainingProblem, initial_state
from vdgs.training.crops import Crop, compute_crops, load_or_compute_crops, mean_crop_area, steps_for
from vdgs.training.schedule import view_sampling_weights
from vdgs.training.session.trainer import (
    finish_stage,
    image_cache_bytes,
    resume_or_start,
    train_with_checkpoints,
    warn_without_densification,
)
from vdgs.training.sky_background import view_sky_masks, view_skylines
from vdgs.visibility.visibility_counts import effective_sample_size


def train_block(
    context: RunContext, index: int, options: CheckpointOptions, console: Console, device: str = "cpu",
    wait: bool = False,
) -> None:  # fmt: skip
    """Train, or continue, one block of a run on a device; nothing if it is finished.

    Works beside other blocks of the run, in this or in other processes. Raises RunError if the run is not cut into
    blocks or has no such block, or another process trains the block, unless it is to `wait` for that; and what training
    raises (see `train_with_checkpoints`).
    """
    options.check()
    run = context.run
    with run.locked(shared=True):
        blocks = load_run_blocks(run)
        if not 0 <= index < len(blocks):
            raise RunError(f"{run.path}: has blocks 0 to {len(blocks) - 1}; there is no block {index}")
        folder, key = run.block(index), run.keys().blocks

        def say_who_is_waited_for() -> None:
            console.print(f"{folder.path}: another vdgs process trains this block; waiting for it", highlight=False)

        with folder.locked(say_who_is_waited_for if wait else None):
            if folder.needs_no_work(key):
                console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
                return
            folder.reset_unless(key)
            _train(context, index, blocks, options, console, torch.device(device))


def train_shard(shard: Shard) -> None:
    """Train, or continue, a block of RUN/blocks for `vdgs train-blocks RUN`, or wait for who trains it: a block that
    somebody trains beside a run is none that failed."""
    options = replace(shard.request(CheckpointOptions), image_cache_gb=shard.image_gb)
    context = RunContext.from_path(shard.folder.parent)
    train_block(context, shard.index, options, shard.console, shard.device, wait=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockPlan:
    """What a block trains with."""

    index: int
    coarse: AnchorModel
    #: The training views of the capture that serve the block.
    indices: list[int]
    views: list[View]
    #: The anchors that the block moves, and those that it only draws.
    anchors: Anchors
    surroundings: Anchors
    config: TrainConfig
    weights: tuple[float, ...] | None
    crops: tuple[Crop, ...] | None

    @property
    def mean_area(self) -> float:
        """Mean share of a photograph that a step draws."""
        return mean_crop_area(self.crops, self.weights) if self.crops else 1.0

    @property
    def can_train(self) -> bool:
        """Whether the block has anchors to move and photographs."""
        return bool(self.views) and len(self.anchors) > 0

    def open_images(self, budget_bytes: int) -> ImageCache:
        """The photographs of the block, in the sizes that its training needs."""
        factors = tuple(sorted({factor for _, factor in self.config.resolution_schedule}))
        return ImageCache(self.views, budget_bytes, downscales=factors)

    def _sky_masks(self, capture: Capture, images: ImageCache) -> tuple[SkyMask | None, ...] | None:
        """The sky in the photographs of the block; None where there is no map of it."""
        if self.coarse.envmap is None:
            return None
        skylines, _ = view_skylines(capture, self.views)
        return view_sky_masks(capture, images, self.config, skylines, self.coarse.envmap, self.coarse.background)

    def problem(
        self, capture: Capture, blocks: Blocks, method: MethodConfig, images: ImageCache, device: torch.device
    ) -> TrainingProblem:
        """What training works on."""
        cameras, coarse, config = [view.camera for view in capture.train_views], self.coarse, self.config
        return TrainingProblem(
            config=config, images=images, num_images=len(self.views), voxel_size=coarse.voxel_size,
            max_pixels=level_sizes(coarse.anchors),
            camera_height=camera_height(capture), offset_rate_factor=offset_rate_factor(capture, config),
            kind="block", background=coarse.background, device=device,
            frozen_decoder=method.block.decoder == "frozen",
            frozen_anchors=FrozenAnchors(self.surroundings, coarse.decoder),
            growth_mask=growth_mask(blocks, self.index, method.block),
            lr_mask=lr_ramp(blocks, self.index, method.block),
            sky_masks=self._sky_masks(capture, images),
            image_indices=self.indices, view_weights=self.weights, crops=self.crops,
            photograph_pixel=coarse.photograph_pixel,
            max_log_scale=(
                (lambda positions: max_log_scales(positions, cameras)) if config.model.bound_scales else None
            ),
        )  # fmt: skip


def plan_block(
    coarse: AnchorModel,
    capture: Capture,
    blocks: Blocks,
    index: int,
    indices: list[int],
    method: MethodConfig,
    keep_crops: Callable[[int, Callable[[], tuple[Crop, ...]]], tuple[Crop, ...]] = lambda count, find: find(),
) -> BlockPlan:
    """What a block trains with, which the training views of these `indices` serve. `keep_crops` is given the number of
    crops and what finds them."""
    views = [capture.train_views[i] for i in indices]
    cameras = [view.camera for view in views]
    owner = blocks.owner(xy_positions(coarse.anchors.positions))
    own, around = split_trainable_anchors(coarse.anchors, blocks, index, method.block, owner)
    around &= visible_anchors(coarse.anchors, cameras)
    anchors, surroundings = coarse.anchors.select(own), coarse.anchors.select(around)
    config, weights, crops = block_train_config(method, len(views)), None, None
    if views and len(anchors):
        owned = np.bincount(owner, minlength=len(blocks))
        limit = max_block_anchors(method.block, int(owned[index]), int(owned.sum()))
        config = replace(config, densify=replace(config.densify, max_anchors=limit))
        weights = view_sampling_weights(config, anchors, cameras)
        if method.block.crop != "off":
            crops = keep_crops(len(views), lambda: compute_crops(coarse, own, cameras))
    plan = BlockPlan(
        index=index, coarse=coarse, indices=indices, views=views, anchors=anchors, surroundings=surroundings,
        config=config, weights=weights, crops=crops,
    )  # fmt: skip
    if method.block.crop != "fixed-pixels" or not crops:
        return plan
    return replace(plan, config=replace(config, iterations=steps_for(config.iterations, plan.mean_area)))


def _train(
    context: RunContext, index: int, blocks: Blocks, options: CheckpointOptions, console: Console, device: torch.device
) -> None:
    run, opened = context.run, context.open_model("coarse", device)
    folder, method = run.block(index), run.method()
    capture, coarse = with_motion_masks(run, opened.capture), opened.model
    start = time.monotonic()
    plan = plan_block(
        coarse, capture, blocks, index, block_view_indices(run, capture, index), method,
        lambda count, find: load_or_compute_crops(folder.path / "crops.json", count, find),
    )  # fmt: skip
    preparation_seconds, views = time.monotonic() - start, plan.views
    metadata = ModelMetadata(
        capture=capture_metadata(opened.capture),
        version=__version__,
        block=index,
        views=len(views),
        key=run.keys().blocks,
    )
    if not plan.can_train:
        keep_coarse_block(folder, replace(coarse, anchors=plan.anchors, metadata=metadata), len(views), console)
        return
    warn_without_densification(plan.config, console, "--block.")
    with plan.open_images(image_cache_bytes(options)) as images:
        stage = plan.problem(capture, blocks, method, images, device)
        state = resume_or_start(
            folder, stage, lambda: initial_state(plan.anchors, coarse.decoder.copy(), stage), console
        )
        state.seconds += preparation_seconds
        worth = f" (worth {effective_sample_size(plan.weights):.0f} used alike)" if plan.weights else ""
        parts = f", {plan.mean_area:.0%} of a photograph each" if plan.crops else ""
        console.print(
            f"block {index}: {len(views)} of {len(capture.train_views)} training views{worth}, {len(plan.anchors):,} "
            f"anchors of its own, {len(plan.surroundings):,} around it, {plan.config.iterations:,} iterations{parts}",
            highlight=False,
        )
        train_with_checkpoints(folder, state, stage, options, console)
    metadata = replace(metadata, iterations=state.iteration, decoder=method.block.decoder)
    finish_stage(folder, state, state.model(stage, metadata), console, plan.mean_area)


def keep_coarse_block(folder: StageFolder, model: AnchorModel, views: int, console: Console) -> None:
    """A block that cannot be trained keeps what the coarse model has there, in one exposure as all blocks are, and says
    why."""
    why = "no camera sees it" if not views else "it holds no anchor"
    model.without_local_exposure().save(folder.model)
    status = StatusRecord(
        state="done", iteration=0, iterations=0, anchors=len(model.anchors), seconds=0.0, reason=why,
        model_id=file_id(folder.model),
    )  # fmt: skip
    folder.set_status(status)
    console.print(f"[yellow]note[/] this block stays as the coarse model has it: {why}", highlight=False)
