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

from vdgs.cameras import Camera
from vdgs.model.anchor_model import AnchorModel
from vdgs.model.anchors import Anchors
from vdgs.model.render import visible_rows

#: Each level has so many times fewer anchors than the one before: all together take a quarter of the model's memory.
THINNING = 5
#: A quick picture draws at most about so many anchors (choice: 25 ms on two cores).
MOST_ANCHORS = 60_000


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

    def __init__(self, model: AnchorModel, most: int = MOST_ANCHORS) -> None:
        self._levels, self._most = [Level(model)], most

    def of(self, camera: Camera, quick: bool) -> Level:
        """The model itself, or for a quick picture the finest one of which the camera sees few enough anchors."""
        whole = self._levels[0]
        if not quick:
            return whole
        shown, number = float(len(visible_rows(whole.model.anchors, camera))), 0
        while shown > self._most:
            shown, number = shown / THINNING, number + 1
        while len(self._levels) <= number:
            self._levels.append(thinned(whole.model, THINNING ** len(self._levels)))
        return self._levels[number]


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
