"""HUG as a comparator: blocks trained one after another, merged by place, measured like the method itself.

RUN/hug/  block-0/ ... (each as RUN/octree)  costs.json  status.json  model.safetensors  levels.safetensors
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from rich.console import Console
from torch import Tensor

from experiments.baselines.evaluation import BaselineFacts, evaluate_baseline
from experiments.baselines.hug.partition import GroundBoxes, cut_ground, pixel_owners
from experiments.baselines.hug.settings import HugConfig
from experiments.baselines.octree_gs.levels import Octree, fit_octree
from experiments.baselines.octree_gs.model import OctreeModel
from experiments.baselines.octree_gs.run import train_levels
from experiments.baselines.octree_gs.training import octree_problem, octree_state
from vdgs import __version__
from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_metadata import capture_metadata
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.validation import require_trainable
from vdgs.config.executor_options import CheckpointOptions
from vdgs.errors import VdgsError
from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel, DecoderSpan, ModelMetadata
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.stage_folder import StageFolder, StatusRecord
from vdgs.system.atomic_files import write_json
from vdgs.system.tensors import file_id
from vdgs.training.session.trainer import image_cache_bytes


@dataclass(frozen=True, eq=False)
class MaskedImages:
    """The photographs of a block, of which its own pixels count (`TrainingImages`)."""

    images: ImageCache
    #: For each photograph, on a coarse grid.
    own: Sequence[Bool[np.ndarray, "_h _w"]]

    def get(self, index: int, downscale: int = 1) -> tuple[Tensor, Tensor]:
        image, mask = self.images.get(index, downscale)
        grid = torch.from_numpy(self.own[index].astype(np.uint8))[None, None]
        own = torch.nn.functional.interpolate(grid, size=image.shape[:2], mode="nearest")[0, 0]
        return image, own if mask is None else own * (mask > 0)

    def camera(self, index: int, downscale: int = 1) -> Camera:
        return self.images.camera(index, downscale)

    def prefetch(self, indices: Sequence[int], downscale: int = 1) -> None:
        self.images.prefetch(indices, downscale)


def level_weights(num_levels: int, ssim_share: float, coarse_weight: float) -> Float[np.ndarray, " k"]:
    """How often each number of levels is drawn, from 1 to all: in proportion to its weight in HUG's loss. The full
    picture has 1; with K = num_levels - 1 levels below it, the picture without the finest k has theta times
    (1 - s) / 2^(K + 1 - k) of L1 and s / 2^k of SSIM, s being SSIM's share."""
    coarse = num_levels - 1
    k = np.arange(coarse, 0, -1)  # coarsest picture first
    weights = coarse_weight * ((1 - ssim_share) / 2.0 ** (coarse + 1 - k) + ssim_share / 2.0**k)
    weights = np.append(weights, 1.0)
    return weights / weights.sum()


def levels_at(config: HugConfig, octree: Octree) -> Callable[[int], int]:
    """How many levels an iteration draws, from (seed, iteration)."""
    training = config.octree.training
    shares = np.cumsum(level_weights(octree.num_levels, training.loss.ssim_lambda, config.coarse_weight))

    def at(iteration: int) -> int:
        drawn = np.random.default_rng((training.seed, 1, iteration)).random()
        return min(int(np.searchsorted(shares, drawn, side="right")) + 1, octree.num_levels)

    return at


def run_hug(
    run: RunFolder,
    capture: Capture,
    config: HugConfig,
    console: Console,
    *,
    lpips_weights: Path | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Train (or continue) in RUN/hug and measure into RUN/evaluation. Raises what `run_octree` raises, and VdgsError
    where a block has no photograph."""
    folder = StageFolder(run.path / "hug")
    with run.locked():
        model = _train(capture, config, folder, console, device)
        write_json(run.capture_file, capture_metadata(capture))
    facts = BaselineFacts(
        name="hug", capture=dict(model.anchors.metadata.capture or {}), trained=folder,
        num_anchors=len(model.anchors.anchors),
    )  # fmt: skip
    return evaluate_baseline(model.to(device), facts, capture, run.evaluation, console, lpips_weights=lpips_weights)


def _train(capture: Capture, config: HugConfig, folder: StageFolder, console: Console, device: str) -> OctreeModel:
    with folder.locked():
        if folder.is_done():
            console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
            return OctreeModel.load(folder.path)
        require_trainable(capture, console)
        views, points = capture.train_views, capture.points
        boxes = cut_ground(points, config.blocks)
        owners = pixel_owners(points, boxes.owner(points[:, :2]), [view.camera for view in views], config.neighbors)
        models, statuses, counts = [], [], []
        for block in range(len(boxes)):
            chosen = [i for i in range(len(views)) if (owners[i] == block).mean() > config.min_share]
            if not chosen:
                raise VdgsError(f"HUG: no photograph shows block {block}. Give fewer --blocks or a smaller min_share.")
            console.print(f"block {block}: {len(chosen)} of {len(views)} photographs", highlight=False)
            own = [owners[i] == block for i in chosen]
            stage = StageFolder(folder.path / f"block-{block}")
            stage.path.mkdir(exist_ok=True)
            shown = [views[i] for i in chosen]
            models.append(_train_block(capture, config, boxes, block, shown, own, stage, console, device))
            statuses.append(stage.status())
            counts.append(len(chosen))
        merged = merge(models, boxes, ModelMetadata(capture=capture_metadata(capture), version=__version__))
        merged.save(folder.path)
        _finish(folder, merged, statuses, counts)
        return merged


def _train_block(
    capture: Capture, config: HugConfig, boxes: GroundBoxes, block: int, views: Sequence[View],
    own: Sequence[Bool[np.ndarray, "_h _w"]], folder: StageFolder, console: Console, device: str,
) -> OctreeModel:  # fmt: skip
    """The model of a block, in its widened box."""
    if folder.is_done():
        return OctreeModel.load(folder.path)

    def within(places: Tensor) -> Tensor:
        return boxes.holds(block, places[:, :2], config.margin)

    cameras = [view.camera for view in views]
    points = capture.points[within(torch.from_numpy(capture.points)).numpy()]
    octree = fit_octree(points, cameras, config.octree)
    with ImageCache(views, image_cache_bytes(CheckpointOptions())) as images:
        problem = octree_problem(
            capture, config.octree, octree, MaskedImages(images, own), cameras, levels_at(config, octree), device
        )
        problem = replace(problem, growth_mask=within if len(boxes) > 1 else None)
        start = lambda: octree_state(points, cameras, problem, octree)  # noqa: E731
        return train_levels(folder, capture, octree, problem, start, console)


def merge(models: Sequence[OctreeModel], boxes: GroundBoxes, metadata: ModelMetadata) -> OctreeModel:
    """Of each block the anchors in its box, with its decoder and its octree."""
    kept = [boxes.holds(block, model.anchors.anchors.positions[:, :2]) for block, model in enumerate(models)]
    anchors = [model.anchors.anchors.select(mask) for model, mask in zip(models, kept, strict=True)]
    everything = anchors[0]
    for more in anchors[1:]:
        everything = everything.concat(more)
    spans = tuple(DecoderSpan(len(a), m.anchors.decoder) for a, m in zip(anchors, models, strict=True))
    first = models[0].anchors
    return OctreeModel(
        AnchorModel(
            anchors=everything, decoder=first.decoder, voxel_size=first.voxel_size, background=first.background,
            metadata=metadata, decoder_spans=spans,
        ),
        torch.cat([model.levels[mask] for model, mask in zip(models, kept, strict=True)]),
        torch.cat([model.bias[mask] for model, mask in zip(models, kept, strict=True)]),
        tuple(model.octrees[0] for model in models),
    )  # fmt: skip


def _finish(folder: StageFolder, model: OctreeModel, blocks: Sequence[StatusRecord], views: Sequence[int]) -> None:
    """Note what all blocks took together."""
    seconds, memory = [each.seconds or 0.0 for each in blocks], [each.peak_memory_bytes or 0 for each in blocks]
    costs = {
        "blocks": len(blocks), "block_seconds": sum(seconds), "longest_block_seconds": max(seconds),
        "block_memory_bytes": max(memory), "cameras_per_block": sum(views) / len(views), "coarse_seconds": None,
    }  # fmt: skip
    write_json(folder.path / "costs.json", costs)
    steps = sum(each.iteration or 0 for each in blocks)
    status = StatusRecord(
        state="done", iteration=steps, iterations=steps, anchors=len(model.levels), seconds=sum(seconds),
        peak_memory_bytes=max(memory), model_id=file_id(folder.model),
    )  # fmt: skip
    folder.set_status(status)
