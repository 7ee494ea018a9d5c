"""The colour behind the scene: the mean of the photographs, in training another one at every step."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vdgs.training.training_state import Stage, TrainingImages


def mean_colour(images: TrainingImages, count: int, downscale: int, at_most: int = 32) -> tuple[float, float, float]:
    """Mean colour in [0, 1] of the pixels that count, over up to `at_most` evenly chosen training views."""
    total, pixels = np.zeros(3), 0
    for index in np.unique(np.linspace(0, count - 1, min(count, at_most)).astype(int)):
        image, mask = images.get(int(index), downscale)
        colours = image.numpy().reshape(-1, 3) if mask is None else image.numpy()[mask.numpy() > 0]
        total += colours.sum(0, dtype=np.float64)
        pixels += len(colours)
    red, green, blue = (float(np.float32(value)) for value in total / (255.0 * max(pixels, 1)))
    return red, green, blue


def background_at(stage: Stage, iteration: int) -> Tensor:
    """Colour [3] behind the scene at this iteration (from 0): from its own to a random one of the RGB cube."""
    colour, share = torch.tensor(stage.background), stage.config.loss.background_noise
    if share:
        generator = torch.Generator().manual_seed(stage.config.seed * 1_000_033 + iteration)
        # Drawn on the CPU: the same colours for any device.
        colour = torch.lerp(colour, torch.rand(3, generator=generator), share)
    return colour.to(stage.device, non_blocking=True)
