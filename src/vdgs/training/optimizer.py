"""Adam over anchors and decoder: visible rows only for anchors, everything for the decoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int32
from torch import Tensor

from vdgs.config.method import LearningRateConfig
from vdgs.kernels import get_backend
from vdgs.kernels.kernel_types import AdamState, IsFinite
from vdgs.model.anchors import TRAINED_TENSORS, Anchors
from vdgs.model.decoder import Decoder

#: The tensor of a decoder that moves by plain steps.
ENVMAP = "envmap"


@dataclass
class AdamMoments:
    """First and second moments of each named parameter, shaped like it."""

    first: dict[str, Tensor]
    second: dict[str, Tensor]

    @staticmethod
    def zeros(parameters: dict[str, Tensor]) -> AdamMoments:
        return AdamMoments(*({name: torch.zeros_like(p) for name, p in parameters.items()} for _ in range(2)))


@dataclass
class AnchorOptimizer:
    """Moments of all parameters, and what the bias correction counts: the updates of each anchor, [n] int32.

    The decoder moves in every step: its updates are the steps.
    """

    anchors: AdamMoments
    decoder: AdamMoments
    updates: Int32[Tensor, " n"]

    @staticmethod
    def zeros(anchors: Anchors, decoder: Decoder) -> AnchorOptimizer:
        trained = {name: tensor for name, tensor in anchors.tensors().items() if name in TRAINED_TENSORS}
        updates = torch.zeros_like(anchors.positions[:, 0], dtype=torch.int32)
        moved = {name: tensor for name, tensor in decoder.tensors().items() if name != ENVMAP}
        return AnchorOptimizer(AdamMoments.zeros(trained), AdamMoments.zeros(moved), updates)

    def anchor_states(self, anchors: Anchors, rates: dict[str, float], lr_boost: float) -> list[AdamState]:
        """The states of `TRAINED_TENSORS`, in that order; `lr_boost` as in `AdamState`."""
        first, second = self.anchors.first, self.anchors.second
        return [
            AdamState(getattr(anchors, name), first[name], second[name], rates[name], lr_boost)
            for name in TRAINED_TENSORS
        ]

    def update_decoder(self, decoder: Decoder, rates: dict[str, float], step: int) -> IsFinite:
        """Step the decoder's tensors by their `.grad`, in place; `step` counts from 1. False: one is not finite. The
        environment map has no moments: see `sky_background`."""
        finite: IsFinite = True
        states, gradients = [], []
        for name, tensor in decoder.tensors().items():
            gradient, tensor.grad = tensor.grad, None
            if gradient is not None and name == ENVMAP:
                finite = torch.isfinite(gradient).all()
                tensor.detach().sub_(gradient, alpha=rates[name])
            elif gradient is not None:
                moments = self.decoder.first[name], self.decoder.second[name]
                states.append(AdamState(tensor.detach(), *moments, rates[name.split("_")[0]]))
                gradients.append(gradient)
        if not states:
            return finite
        return get_backend(gradients[0].device).adam_tensors(states, gradients, step) & finite


def learning_rates_at(config: LearningRateConfig, progress: float) -> dict[str, float]:
    """Learning rates at a share of the stage in [0, 1]: exponential from the first to the second value."""
    pairs = {name: getattr(config, name) for name in LearningRateConfig.__dataclass_fields__}
    return {name: first * (last / first) ** progress for name, (first, last) in pairs.items()}
