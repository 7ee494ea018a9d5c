"""Adam over anchors and decoder: visible rows only for anchors, everything for the decoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from vdgs.kernels import native as kernels
from vdgs.kernels.types import AdamState
from vdgs.model.anchors import TRAINED, Anchors
from vdgs.model.decoder import Decoder
from vdgs.settings.method import RateConfig


def rebuild(tensors: dict[str, Tensor], more: dict[str, Tensor], kept: Tensor) -> None:
    """Append to each tensor the rows of its name in `more`, then keep the `kept` rows (mask or order); in place.

    Each old tensor is let go before the next is made: if nothing else holds it, no more than one is there twice.
    """
    for name in list(tensors):
        before, added = tensors.pop(name), more[name]
        if kept.dtype != torch.bool:
            tensors[name] = (torch.cat([before, added]) if len(added) else before).index_select(0, kept)
            continue
        old, new = kept[: len(before)], kept[len(before) :]
        stays, comes = int(old.sum()), int(new.sum())
        tensors[name] = before.new_empty(stays + comes, *before.shape[1:])
        torch.index_select(before, 0, old.nonzero()[:, 0], out=tensors[name][:stays])
        torch.index_select(added, 0, new.nonzero()[:, 0], out=tensors[name][stays:])


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

    def rebuild(self, added: int, kept: Tensor) -> None:
        """For anchors: append `added` rows without history, then keep only the `kept` rows (mask or order).

        Tensor by tensor, so that no more than one is there twice.
        """
        for tensors in (self.first, self.second):
            rebuild(tensors, {name: t.new_zeros(added, *t.shape[1:]) for name, t in tensors.items()}, kept)


@dataclass
class Optimiser:
    """Moments of all parameters; `step` counts updates from 1 (for the bias correction)."""

    anchors: Moments
    decoder: Moments

    @staticmethod
    def start(anchors: Anchors, decoder: Decoder) -> Optimiser:
        trained = {name: tensor for name, tensor in anchors.tensors().items() if name in TRAINED}
        return Optimiser(Moments.zeros(trained), Moments.zeros(decoder.tensors()))

    def anchor_states(self, anchors: Anchors, rates: dict[str, float]) -> list[AdamState]:
        """What moves of the anchors, in the order of `TRAINED`."""
        return [
            AdamState(getattr(anchors, name), self.anchors.first[name], self.anchors.second[name], rates[name])
            for name in TRAINED
        ]

    def update_decoder(self, decoder: Decoder, rates: dict[str, float], step: int) -> bool:
        """Move the decoder's tensors by their `.grad`, in place. False: a gradient is not finite."""
        finite = True
        for name, tensor in decoder.tensors().items():
            if tensor.grad is not None:
                finite &= kernels.adam_rows(
                    tensor.detach(), None, tensor.grad, self.decoder.first[name], self.decoder.second[name],
                    learning_rate=rates[name.split("_")[0]], step=step,
                )  # fmt: skip
                tensor.grad = None
        return finite


def rates_at(config: RateConfig, progress: float) -> dict[str, float]:
    """Learning rates at a share of the stage in [0, 1]: exponential from the first to the second value."""
    pairs = {name: getattr(config, name) for name in RateConfig.__dataclass_fields__}
    return {name: first * (last / first) ** progress for name, (first, last) in pairs.items()}
