"""Levels of detail of a model without a tree (`vdgs lod`): fewer, larger Gaussians for previews, whose time follows
from their number, not from pixels.

Only previews of a moving camera use them, where so much is in view that single Gaussians are small. At rest the model
itself is drawn.
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
from vdgs.model.renderer import Drawable, cull_anchors

#: The first level has so many times fewer anchors than the model, each further one so many times fewer than the one
#: before it: all together take 0.3 of the model's memory.
FIRST_FACTOR, NEXT_FACTOR = 5, 3


@dataclass(frozen=True, eq=False)
class LodLevel:
    """What is drawn, and which anchors of the whole model it holds; None: all."""

    model: Drawable
    mask: Bool[Tensor, " n"] | None = None

    def of(self, values: Tensor) -> Tensor:
        """Of values of all anchors, those of the anchors that it holds."""
        return values if self.mask is None else values[self.mask]


class LodPyramid:
    """A model and its thinner ones, each made when it is first needed."""

    def __init__(self, model: AnchorModel) -> None:
        self.model = model
        self._levels = [LodLevel(model)]

    def of(self, camera: Camera, max_anchors: int | None = None) -> tuple[LodLevel, int]:
        """The model itself, or the finest level of which the camera sees at most so many anchors; and about how many
        of them it sees."""
        model = self.model
        visible, number = len(cull_anchors(model.anchors, camera)), 0
        while max_anchors is not None and visible // decimation_factor(number) > max(max_anchors, 1):
            number += 1
        while len(self._levels) <= number:
            self._levels.append(decimate(model, decimation_factor(len(self._levels))))
        return self._levels[number], visible // decimation_factor(number)


def decimation_factor(level: int) -> int:
    """How many times fewer anchors a level has than the model, which is level 0."""
    return FIRST_FACTOR * NEXT_FACTOR ** (level - 1) if level else 1


def decimate(model: AnchorModel, factor: int) -> LodLevel:
    """One anchor of so many, by chance but always the same, its Gaussians so much larger that they cover as much."""
    count, device = len(model.anchors), model.anchors.positions.device
    chance = torch.rand(count, generator=torch.Generator().manual_seed(0), dtype=torch.float32, device="cpu")
    kept = (chance < 1 / factor).to(device)
    fewer = model.select_anchors(kept)
    log_scales = fewer.anchors.log_scales.clone()
    log_scales[:, 3:] += 0.5 * math.log(factor)
    return LodLevel(replace(fewer, anchors=Anchors(**{**fewer.anchors.tensors(), "log_scales": log_scales})), kept)
