"""Adam over anchors and decoder: visible rows only for anchors, everything for the decoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Int32
from torch import Tensor

from vdgs.config.method import RateConfig
from vdgs.kernels import choose
from vdgs.kernels.kernel_types import AdamState, Finite
from vdgs.model.anchors import TRAINED, Anchors
from vdgs.model.decoder import Decoder


@dataclass
class Moments:
    """First and second moments of each named parameter, shaped like it."""

    first: dict[str, Tensor]
    second: dict[str, Tensor]

    @staticmethod
    def zeros(parameters: dict[str, Tensor]) -> Moments:
        return Moments(
            {name: torch.zeros_like(p) for name, p in parameters.items()},
            {name: torch.zeros_like(p) for name, p in parameters.items()},
        )


@dataclass
class Optimiser:
    """Moments of all parameters, and what the bias correction counts: the updates of each anchor, [n] int32.

    The decoder moves in every step: its updates are the steps.
    """

    anchors: Moments
    decoder: Moments
    updates: Int32[Tensor, " n"]

    @staticmethod
    def start(anchors: Anchors, decoder: Decoder) -> Optimiser:
        trained = {name: tensor for name, tensor in anchors.tensors().items() if name in TRAINED}
        updates = torch.zeros_like(anchors.positions[:, 0], dtype=torch.int32)
        return Optimiser(Moments.zeros(trained), Moments.zeros(decoder.tensors()), updates)

    def anchor_states(self, anchors: Anchors, rates: dict[str, float], early: float) -> list[AdamState]:
        """What moves of the anchors, in the order of `TRAINED`; `early` as in `AdamState`."""
        return [
            AdamState(getattr(anchors, name), self.anchors.first[name], self.anchors.second[name], rates[name], early)
            for name in TRAINED
        ]

    def update_decoder(self, decoder: Decoder, rates: dict[str, float], step: int) -> Finite:
        """Move the decoder's tensors by their `.grad`, in place; `step` counts from 1.

        False: a gradient is not finite.
        """
        finite: Finite = True
        for name, tensor in decoder.tensors().items():
            if tensor.grad is not None:
                moments = self.decoder.first[name], self.decoder.second[name]
                state = AdamState(tensor.detach(), *moments, rates[name.split("_")[0]])
                finite = choose(tensor.device).adam_rows(state, None, tensor.grad, step) & finite
                tensor.grad = None
        return finite


def rates_at(config: RateConfig, progress: float) -> dict[str, float]:
    """Learning rates at a share of the stage in [0, 1]: exponential from the first to the second value."""
    pairs = {name: getattr(config, name) for name in RateConfig.__dataclass_fields__}
    return {name: first * (last / first) ** progress for name, (first, last) in pairs.items()}
