"""The geometry of block training: what a block moves, what it only draws, where it grows, how far its anchors move.

Frozen around the core are the ring out to the widened boundary and, as context, all else that the block's cameras see
(choice: else every pixel that no anchor covers would push the anchors at the boundary to fill the hole).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.config.method import BlockConfig
from vdgs.geometry.camera import Camera
from vdgs.model.anchors import Anchors
from vdgs.model.renderer import cull_anchors
from vdgs.partition.blocks import Blocks, xy_positions

#: Cells on each side of the table of the ramp.
RAMP_TABLE_SIZE = 512


def split_trainable_anchors(
    anchors: Anchors, blocks: Blocks, index: int, config: BlockConfig, owner: Int64[np.ndarray, " n"] | None = None
) -> tuple[Tensor, Tensor]:
    """What a block moves and what it only draws, as two masks [n]; `owner` of the anchors, if already known.

    Own are the anchors of the core (with a ring that is not frozen: of the widened block). Around are the ring and,
    with `config.draw_outside`, everything else.
    """
    points = xy_positions(anchors.positions)
    owner = blocks.owner(points) if owner is None else owner
    core, reached = owner == index, blocks.in_expanded(index, points, owner)
    own = core if config.margin == "frozen" else reached
    around = ~own if config.draw_outside else reached & ~own
    device = anchors.positions.device
    return torch.from_numpy(own).to(device), torch.from_numpy(around).to(device)


def visible_anchors(anchors: Anchors, cameras: Sequence[Camera]) -> Bool[Tensor, " n"]:
    """Which anchors one of the cameras may draw, in steps that draw all levels too."""
    drawn, anchors = torch.zeros_like(anchors.positions[:, 0], dtype=torch.bool), anchors.with_all_levels()
    for camera in cameras:
        drawn[cull_anchors(anchors, camera)] = True
    return drawn


def growth_mask(blocks: Blocks, index: int, config: BlockConfig) -> Callable[[Tensor], Tensor]:
    """Which points may get new anchors: those the block owns (with a ring that is not frozen: its widened ones)."""

    def inside(positions: Float[Tensor, "p 3"]) -> Bool[Tensor, " p"]:
        points = xy_positions(positions)
        grows = blocks.owner(points) == index if config.margin == "frozen" else blocks.in_expanded(index, points)
        return torch.from_numpy(grows).to(positions.device)

    return inside


def lr_ramp(blocks: Blocks, index: int, config: BlockConfig) -> Callable[[Tensor], Tensor] | None:
    """The learning-rate mask of a ramp: 1 where the block owns the point, elsewhere falling linearly from the core to 0
    at the widened boundary. It reads a table, because every step calls it."""
    if config.margin != "ramp":
        return None
    block = blocks.items[index]
    low, high = np.array(block.expanded.bounds[:2]), np.array(block.expanded.bounds[2:])
    cells = np.indices((RAMP_TABLE_SIZE, RAMP_TABLE_SIZE)).reshape(2, -1).T
    centers = (cells + 0.5) / RAMP_TABLE_SIZE * (high - low) + low
    owned = blocks.owner(centers) == index
    shapely.prepare(block.expanded)
    margin = shapely.contains_xy(block.expanded, centers) & ~owned
    points = shapely.points(centers[margin])  # distances to outlines take long
    inwards, outwards = shapely.distance(block.core, points), shapely.distance(block.expanded.boundary, points)
    share = owned.astype(np.float32)
    share[margin] = outwards / np.maximum(inwards + outwards, 1e-12)
    arrays = share.reshape(RAMP_TABLE_SIZE, RAMP_TABLE_SIZE), low, (high - low) / RAMP_TABLE_SIZE

    @cache
    def on(device: torch.device) -> list[Tensor]:
        return [torch.from_numpy(each).to(device) for each in arrays]

    def rate_mask(positions: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
        table, origin, cell = on(positions.device)
        cells: Int64[Tensor, "p 2"] = ((positions[:, :2].double() - origin) / cell).floor().long()
        inside = ((cells >= 0) & (cells < RAMP_TABLE_SIZE)).all(1)
        cells = cells.clamp(0, RAMP_TABLE_SIZE - 1)
        # What the block moves beyond the table it owns.
        return torch.where(inside, table[cells[:, 0], cells[:, 1]], 1.0)

    return rate_mask
