"""The mean of the last models of training (Polyak and Juditsky, 1992), in place of the very last one.

Where learning rates do not decay (features, log-scales), Adam ends near the optimum, displaced by the last photographs.
The mean over many iterations is nearer, most of all for what few photographs show (choice).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vdgs.config.method import TrainConfig
from vdgs.model.anchors import TRAINED_TENSORS, Anchors
from vdgs.model.decoder import Decoder

#: About how many models are averaged.
NUM_AVERAGED_MODELS = 100


@dataclass
class ModelAverage:
    """The mean of `count` models with the same anchors in the same order."""

    count: int
    #: By name, as `Anchors.tensors` without positions, which never move, and as `Decoder.tensors`.
    anchors: dict[str, Tensor]
    decoder: dict[str, Tensor]

    @staticmethod
    def of(anchors: Anchors, decoder: Decoder) -> ModelAverage:
        """The mean of one model, in tensors of its own."""
        trained = {name: getattr(anchors, name).clone() for name in TRAINED_TENSORS}
        return ModelAverage(1, trained, decoder.copy().tensors())

    @torch.no_grad()
    def add(self, anchors: Anchors, decoder: Decoder) -> None:
        """Count one more model, in place. What is the same in all of them keeps its bits."""
        self.count += 1
        for name, mean in self.anchors.items():
            mean.lerp_(getattr(anchors, name), 1 / self.count)
        for name, mean in self.decoder.items():
            mean.lerp_(decoder.tensors()[name], 1 / self.count)


def is_averaged_step(iteration: int, config: TrainConfig) -> bool:
    """Whether the model after `iteration` steps is averaged: about `NUM_AVERAGED_MODELS`, evenly spread over the last
    `config.swa_fraction` of the iterations and after the end of growth, the last one included."""
    begin = max(1 - config.swa_fraction, config.densify.stop_fraction) * config.iterations
    every = max(1, round((config.iterations - begin) / NUM_AVERAGED_MODELS))
    return config.swa_fraction > 0 and iteration > begin and (config.iterations - iteration) % every == 0
