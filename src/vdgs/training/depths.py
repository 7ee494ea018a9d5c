"""What is asked of the depth of a picture where few cameras look: to agree with sparse points, and to be smooth.

Photographs that are few leave depth open: many surfaces explain them. Both terms are weighted by how seldom a place is
seen (`model.seldom`), so that they leave alone what photographs decide. Depth is the drawn one, D / alpha: the expected
depth of what is drawn, where that is at least half opaque.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64, UInt8
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.captures.sightings import Sightings
from vdgs.model.seldom import Seldom

#: Below this alpha a pixel has no depth.
LEAST_ALPHA = 0.5
#: A difference of colours in the photograph, over two pixels, at which depth may bend 1/e as dearly (choice).
EDGE = 0.1


@dataclass(frozen=True, eq=False)
class KnownDepths:
    """Where a photograph shows sparse points: rays x/z and y/z of its camera, depth along its axis, and how seldom each
    point is seen."""

    rays: Float[Tensor, "p 2"]
    depth: Float[Tensor, " p"]
    weight: Float[Tensor, " p"]

    @staticmethod
    def of(sightings: Sightings, camera: Camera, seldom: Seldom) -> KnownDepths:
        """Those of a photograph, whatever size its camera has."""
        device = seldom.starts.device
        points, rays = (torch.from_numpy(each).float().to(device) for each in (sightings.points, sightings.rays))
        _, depth = camera.project(sightings.points)
        return KnownDepths(rays, torch.from_numpy(depth).float().to(device), seldom.share(points))

    def in_picture(self, camera: Camera, mask: UInt8[Tensor, "h w"] | None) -> PixelDepths:
        """The pixels of a picture (or a part of it) by this camera that show the points."""
        column, row = (
            (self.rays[:, axis] * focal + centre).floor().long()
            for axis, (focal, centre) in enumerate(((camera.fx, camera.cx), (camera.fy, camera.cy)))
        )
        held = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (self.depth > 0)
        if mask is not None:
            held[held.clone()] = mask[row[held], column[held]] > 0
        return PixelDepths(row[held], column[held], self.depth[held], self.weight[held])


@dataclass(frozen=True, eq=False)
class PixelDepths:
    """Pixels of a picture with the depth that is known there."""

    row: Int64[Tensor, " p"]
    column: Int64[Tensor, " p"]
    depth: Float[Tensor, " p"]
    weight: Float[Tensor, " p"]

    def error(self, depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
        """The mean over the pixels of weight · |drawn - known| / known; `depth` is not divided by `alpha`. A pixel that
        is less than half opaque counts as right: whether it should be opaque is not asked here."""
        alpha = alpha[self.row, self.column]
        drawn = depth[self.row, self.column] / alpha.clamp(min=LEAST_ALPHA)
        wrong = self.weight * (drawn - self.depth).abs() / self.depth
        return torch.where(alpha >= LEAST_ALPHA, wrong, 0.0).sum() / max(len(wrong), 1)


def roughness(
    depth: Float[Tensor, "h w"],
    alpha: Float[Tensor, "h w"],
    photograph: UInt8[Tensor, "h w 3"],
    weight: Float[Tensor, "h w"],
) -> Float[Tensor, ""]:
    """The mean over a picture of weight · |second difference of 1 / depth| · depth, along rows and along columns.

    On a plane, seen from anywhere, 1 / depth is linear in the pixels: any plane is smooth, however slanted. Where the
    photograph has an edge, depth may bend. `depth` is not divided by `alpha`; what is less than half opaque, or has a
    neighbour that is, counts as smooth.
    """
    opaque = alpha >= LEAST_ALPHA
    inverse = torch.where(opaque, alpha, 1.0) / torch.where(opaque, depth, 1.0)
    colours = photograph.float() / 255.0
    return (
        _bends(inverse, opaque, colours, weight) + _bends(inverse.T, opaque.T, colours.transpose(0, 1), weight.T)
    ) / depth.numel()


def _bends(inverse: Tensor, opaque: Tensor, colours: Tensor, weight: Tensor) -> Float[Tensor, ""]:
    """The sum of `roughness` along rows."""
    middle = inverse[:, 1:-1]
    bend = (inverse[:, :-2] - 2.0 * middle + inverse[:, 2:]).abs() / middle
    even = (-(colours[:, 2:] - colours[:, :-2]).abs().mean(-1) / EDGE).exp()
    counted = opaque[:, :-2] & opaque[:, 1:-1] & opaque[:, 2:]
    return torch.where(counted, weight[:, 1:-1] * even * bend, 0.0).sum()
