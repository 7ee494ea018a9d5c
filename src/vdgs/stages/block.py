"""Block training (section III-B): one block, from the coarse anchors of its place, with its own cameras.

The decoder is frozen, or each block trains a copy of its own. What lies around the block's core is drawn and never
moves: the ring out to its widened boundary and, as context, all else that its cameras see (choice: else every pixel
that no anchor covers would push the anchors at the boundary to fill the hole).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int64
from rich.console import Console
from torch import Tensor

from vdgs import __version__
from vdgs.anchors import AnchorModel, Anchors
from vdgs.cameras import Camera
from vdgs.captures.capture import Capture
from vdgs.captures.facts import capture_facts
from vdgs.captures.images import ImageCache
from vdgs.config import BlockConfig, block_training
from vdgs.errors import RunError
from vdgs.kernels import native as kernels
from vdgs.partition.blocks import Blocks, load_blocks
from vdgs.partition.saving import load_scores
from vdgs.run import RunFolder, StageFolder
from vdgs.run_options import WatchOptions
from vdgs.stages.anchor_watching import continue_or_start, finish, identity, train_watched
from vdgs.stages.coarse import camera_height, image_budget, note_without_growth, shares_for
from vdgs.stages.opening import open_run
from vdgs.training import Stage, Surroundings, start_state
from vdgs.training.crops import crops_of, load_or_find, mean_area, steps_for
from vdgs.visibility import effective_count

#: Cells on each side of the table of the ramp.
RAMP_CELLS = 512


def train_block(path: Path, index: int, options: WatchOptions, console: Console) -> None:
    """Train, or continue, one block of a run; nothing if it is finished.

    Works beside other blocks of the run, in this or in other processes. Raises RunError if the run is not cut into
    blocks or has no such block, and what training raises (see `train_watched`).
    """
    options.check()
    run = RunFolder(path)
    with run.locked(shared=True):
        blocks = blocks_of(run)
        if not 0 <= index < len(blocks):
            raise RunError(f"{path}: has blocks 0 to {len(blocks) - 1}; there is no block {index}")
        folder, key = run.block(index), run.keys().blocks
        with folder.locked():
            if folder.is_done(key):
                console.print(f"{folder.model}: already trained; nothing to do", highlight=False)
                return
            folder.claim(key)
            _train(run, index, blocks, options, console)


def blocks_of(run: RunFolder) -> Blocks:
    """The blocks of a run, with cameras. Raises RunError unless they were made with the run's settings."""
    facts, keys = run.partition_facts(), run.keys()
    if (facts.get("key"), facts.get("assignment_key")) != (keys.partition, keys.assignment):
        raise RunError(
            f"{run.path}: is not cut into blocks yet, or with other settings. Run: vdgs partition {run.path}"
        )
    return load_blocks(run.partition / "blocks.geojson")


def views_of_block(run: RunFolder, capture: Capture, index: int) -> list[int]:
    """Which training views, by number, serve a block."""
    _, _, assignment = load_scores(run.partition / "scores.npz")
    if len(assignment.cameras) != len(capture.train_views):
        raise RunError(f"{run.partition / 'scores.npz'}: is of another capture. Run: vdgs partition {run.path}")
    return [int(view) for view in np.flatnonzero(assignment.cameras[:, index])]


def _train(run: RunFolder, index: int, blocks: Blocks, options: WatchOptions, console: Console) -> None:
    opened, folder, method = open_run(run.path, "coarse"), run.block(index), run.method()
    capture, coarse = opened.capture, opened.model
    chosen = views_of_block(run, capture, index)
    views = [capture.train_views[i] for i in chosen]
    facts = {"capture": capture_facts(capture), "version": __version__, "block": index, "views": len(views)}
    own, around = split_anchors(coarse.anchors, blocks, index, method.block)
    around &= drawn_by(coarse.anchors, [view.camera for view in views])
    anchors, surroundings = coarse.anchors.select(own), coarse.anchors.select(around)
    if not views or not len(anchors):
        _keep_coarse(folder, replace(coarse, anchors=anchors, facts=facts), len(views), console)
        return
    config = block_training(method, len(views))
    shares = shares_for(config, anchors, views)
    began = time.monotonic()
    crops = None
    if method.block.crop != "off":
        cameras = [view.camera for view in views]
        crops = load_or_find(folder.path / "crops.json", len(views), lambda: crops_of(coarse, own, cameras))
    area = mean_area(crops, shares) if crops else 1.0
    if method.block.crop == "pixels":
        config = replace(config, iterations=steps_for(config.iterations, area))
    prepared = time.monotonic() - began
    note_without_growth(config, console, "--block.")
    factors = tuple(sorted({factor for _, factor in config.resolutions}))
    with ImageCache(views, image_budget(options), downscales=factors) as images:
        stage = Stage(
            config, images, len(views), coarse.voxel, camera_height(capture), coarse.background,
            frozen_decoder=method.block.decoder == "frozen", surroundings=Surroundings(surroundings, coarse.decoder),
            may_hold=holds(blocks, index, method.block), mobility=ramp(blocks, index, method.block),
            appearance_of=chosen, shares=shares, crops=crops,
        )  # fmt: skip
        state = continue_or_start(folder, stage, lambda: start_state(anchors, coarse.decoder.copy(), stage), console)
        state.seconds += prepared
        parts = f", {area:.0%} of a photograph each" if crops else ""
        console.print(
            f"block {index}: {_views_served(len(views), len(capture.train_views), shares)}, {int(own.sum()):,} anchors "
            f"of its own, {len(surroundings):,} around it, {config.iterations:,} iterations{parts}",
            highlight=False,
        )
        train_watched(folder, state, stage, options, console)
    model = AnchorModel(
        *state.result(),
        coarse.voxel,
        coarse.background,
        facts | {"iterations": state.iteration, "decoder": method.block.decoder},
    )
    finish(folder, state, model, console, area)


def _views_served(count: int, of: int, shares: Sequence[float] | None) -> str:
    """How many views a block has, in words, and how many they are worth where some are used more than others."""
    worth = f" (worth {effective_count(shares):.0f} used alike)" if shares else ""
    return f"{count} of {of} training views{worth}"


def _keep_coarse(folder: StageFolder, model: AnchorModel, views: int, console: Console) -> None:
    """A block that cannot be trained keeps what the coarse model has there, and says why."""
    why = "no camera sees it" if not views else "it holds no anchor"
    model.save(folder.model)
    folder.set_status(
        "done", iteration=0, iterations=0, anchors=len(model.anchors), seconds=0.0, why=why,
        model=identity(folder.model),
    )  # fmt: skip
    console.print(f"[yellow]note[/] this block stays as the coarse model has it: {why}", highlight=False)


def places(positions: Float[Tensor, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """x and y of anchors, in the precision in which places have owners."""
    return positions[:, :2].double().numpy()


def split_anchors(anchors: Anchors, blocks: Blocks, index: int, config: BlockConfig) -> tuple[Tensor, Tensor]:
    """What a block moves and what it only draws, as two masks [n].

    Own are the anchors that the block owns (with a ring that is not frozen: that it reaches). Around it are the ring
    and, with `config.context`, everything else.
    """
    place = places(anchors.positions)
    core, reached = blocks.owner(place) == index, blocks.reaches(index, place)
    own = core if config.ring == "frozen" else reached
    around = ~own if config.context else reached & ~own
    return torch.from_numpy(own), torch.from_numpy(around)


def drawn_by(anchors: Anchors, cameras: Sequence[Camera]) -> Bool[Tensor, " n"]:
    """Which anchors one of the cameras may draw."""
    drawn = torch.zeros(len(anchors), dtype=torch.bool)
    for camera in cameras:
        drawn[kernels.cull(anchors.positions, anchors.log_scales, camera)] = True
    return drawn


def holds(blocks: Blocks, index: int, config: BlockConfig) -> Callable[[Tensor], Tensor]:
    """Which places may get new anchors: those of which the merge keeps what stands there."""

    def inside(positions: Float[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        place = places(positions)
        kept = blocks.owner(place) == index if config.ring == "frozen" else blocks.reaches(index, place)
        return torch.from_numpy(kept)

    return inside


def ramp(blocks: Blocks, index: int, config: BlockConfig) -> Callable[[Tensor], Tensor] | None:
    """How far anchors move where the ring is a ramp: 1 wherever the block owns the place, and where another does,
    falling linearly from the core to 0 at the widened boundary.

    Read from a table over the block, since it is asked in every step.
    """
    if config.ring != "ramp":
        return None
    block = blocks.items[index]
    low, high = np.array(block.expanded.bounds[:2]), np.array(block.expanded.bounds[2:])
    centres = (np.indices((RAMP_CELLS, RAMP_CELLS)).reshape(2, -1).T + 0.5) / RAMP_CELLS * (high - low) + low
    points = shapely.points(centres)
    inwards, outwards = shapely.distance(block.core, points), shapely.distance(block.expanded.exterior, points)
    share = np.where(shapely.contains(block.expanded, points), outwards / np.maximum(inwards + outwards, 1e-12), 0.0)
    share = np.where(blocks.owner(centres) == index, 1.0, share)
    table = torch.from_numpy(share.astype(np.float32).reshape(RAMP_CELLS, RAMP_CELLS))
    origin, cell = torch.from_numpy(low), torch.from_numpy((high - low) / RAMP_CELLS)

    def mobility(positions: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        cells: Int64[Tensor, "p 2"] = ((positions[:, :2].double() - origin) / cell).floor().long()
        inside = ((cells >= 0) & (cells < RAMP_CELLS)).all(1)
        cells = cells.clamp(0, RAMP_CELLS - 1)
        # What the block moves beyond the table it owns.
        return torch.where(inside, table[cells[:, 0], cells[:, 1]], torch.ones(()))

    return mobility
