"""A short training of a checkerboard."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from support.checkerboard import Photographs
from vdgs.config.method import DensifyConfig, ModelConfig, TrainConfig
from vdgs.model.decoder import Decoder
from vdgs.model.initialization.initialize import initialize_anchors
from vdgs.training import TrainingProblem, initial_state, to_checkpoint, train

BLACK = (0.0, 0.0, 0.0)


CONFIG = TrainConfig(
    iterations=60,
    resolution_schedule=((0.0, 2), (0.5, 1)),
    model=ModelConfig(num_offsets=4, appearance_dim=3),
    densify=DensifyConfig(
        every=10, stats_start=5, start=20, stop_fraction=0.9, grad_threshold=1e-6, min_draw_fraction=0.05
    ),
)


def stage(config: TrainConfig = CONFIG) -> TrainingProblem:
    return TrainingProblem(config=config, images=Photographs(), num_images=8, voxel_size=0.4, camera_height=5.0)


def start(config: TrainConfig = CONFIG):
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-4, 4, (300, 2)), np.zeros((300, 1))], axis=1)
    anchors, _ = initialize_anchors(
        points,
        np.full((300, 3), 128, np.uint8),
        Photographs().cameras,
        replace(config.init, voxel_size=0.4),
        config.model.num_offsets,
    )
    generator = torch.Generator().manual_seed(config.seed)
    decoder = Decoder.init_random(config.model.num_offsets, False, config.model.appearance_dim, 8, generator)
    return initial_state(anchors, decoder, stage(config))


def run(state, stage_, until: int | None = None):
    train(
        state, stage_,
        stop=lambda: until is not None and state.iteration >= until, after_step=lambda *_: None,
    )  # fmt: skip
    return state


def bits(state) -> dict[str, bytes]:
    return {name: tensor.numpy().tobytes() for name, tensor in to_checkpoint(state).tensors.items()}
