"""Fewer, larger Gaussians for quick pictures: what takes time is how many there are, not how many pixels they fill.

Only pictures of a moving camera are drawn with them, and only where so much is in view that single Gaussians are small.
At rest the model itself is drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.renderer import visible_rows

#: The first level has so many times fewer anchors than the model, each further one so many times fewer than the one
#: before it: all together take 0.3 of the model's memory.
FIRST, FURTHER = 5, 3


@dataclass(frozen=True, eq=False)
class Level:
    """A model, and which anchors of the whole one it holds; None: all."""

    model: AnchorModel
    kept: Bool[Tensor, " n"] | None = None

    def of(self, values: Tensor) -> Tensor:
        """What is known of all anchors, of those that it holds."""
        return values if self.kept is None else values[self.kept]


class Levels:
    """A model and its thinner ones, each made when it is first needed."""

    def __init__(self, model: AnchorModel) -> None:
        self._levels = [Level(model)]

    def of(self, camera: Camera, most: int | None = None) -> tuple[Level, int]:
        """The model itself, or the finest level of which the camera sees at most so many anchors; and how many it
        sees of it, about."""
        whole = self._levels[0]
        shown, number = len(visible_rows(whole.model.anchors, camera)), 0
        if most is None:
            return whole, shown
        while shown // times_of(number) > max(most, 1):
            number += 1
        while len(self._levels) <= number:
            self._levels.append(thinned(whole.model, times_of(len(self._levels))))
        return self._levels[number], shown // times_of(number)


def times_of(level: int) -> int:
    """How many times fewer anchors a level has than the model, which is level 0."""
    return FIRST * FURTHER ** (level - 1) if level else 1


def thinned(model: AnchorModel, times: int) -> Level:
    """One anchor of so many, by chance but always the same, its Gaussians so much larger that they cover as much."""
    count, device = len(model.anchors), model.anchors.positions.device
    chance = torch.rand(count, generator=torch.Generator().manual_seed(0))
    kept = (chance < 1 / times).to(device)
    anchors = model.anchors.select(kept)
    log_scales = anchors.log_scales.clone()
    log_scales[:, 3:] += 0.5 * math.log(times)
    sums = torch.cat([torch.zeros(1, dtype=torch.long), kept.long().cumsum(0).cpu()])
    parts, first = [], 0
    for part in model.parts:
        parts.append(replace(part, count=int(sums[first + part.count] - sums[first])))
        first += part.count
    fewer = Anchors(**{**anchors.tensors(), "log_scales": log_scales})
    return Level(replace(model, anchors=fewer, parts=tuple(parts)), kept)
