"""A plane of anchors, cut into two blocks, and the stage that trains one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
import torch

from support.checkerboard import Photographs
from vdgs.config.method import BlockConfig, CompensationConfig, DensifyConfig, InitConfig, ModelConfig, TrainConfig
from vdgs.model.anchors import Anchors
from vdgs.model.decoder import Decoder
from vdgs.model.initialization.initialize import initialize_anchors
from vdgs.partition.block_regions import growth_mask, lr_ramp, split_trainable_anchors, visible_anchors
from vdgs.partition.blocks import Block, Blocks
from vdgs.training import FrozenAnchors, TrainingProblem, TrainingState, initial_state

CONFIG = TrainConfig(
    iterations=40,
    model=ModelConfig(num_offsets=4),
    densify=DensifyConfig(
        every=10,
        stats_start=0,
        start=10,
        stop_fraction=1.0,
        grad_threshold=1e-6,
        coarsest_voxels=4.0,
        min_draw_fraction=0.05,
    ),
    compensation=CompensationConfig(t_low=0.5),
)
#: West, where blocks are cut at x = 0, and east.
BLOCKS = Blocks(
    (
        Block(shapely.box(-4, -4, 0, 4), shapely.box(-5, -5, 1, 5)),
        Block(shapely.box(0, -4, 4, 4), shapely.box(-1, -5, 5, 5)),
    )
)


def coarse() -> tuple[Anchors, Decoder]:
    x, y = np.meshgrid(np.arange(-3.9, 4, 0.4), np.arange(-3.1, 3.2, 0.4))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    anchors, _ = initialize_anchors(points, np.zeros((x.size, 3), np.uint8), [], InitConfig(voxel_size=0.4), 4)
    generator = torch.Generator().manual_seed(0)
    anchors = replace(
        anchors,
        features=torch.randn(len(anchors), 32, generator=generator) * 0.3,
        offsets=torch.randn(len(anchors), 4, 3, generator=generator) * 0.3,
    )
    return anchors, Decoder.init_random(4, False, 0, 8, generator)


def block_stage(
    config: BlockConfig, index: int = 0, training: TrainConfig = CONFIG
) -> tuple[TrainingProblem, TrainingState]:
    anchors, decoder = coarse()
    photographs = Photographs()
    own, around = split_trainable_anchors(anchors, BLOCKS, index, config)
    surroundings = anchors.select(around & visible_anchors(anchors, photographs.cameras))
    stage = TrainingProblem(
        config=training, images=photographs, num_images=8, voxel_size=0.4, camera_height=5.0, frozen_decoder=True,
        frozen_anchors=FrozenAnchors(surroundings, decoder), growth_mask=growth_mask(BLOCKS, index, config),
        lr_mask=lr_ramp(BLOCKS, index, config),
    )  # fmt: skip
    return stage, initial_state(anchors.select(own), decoder, stage)
