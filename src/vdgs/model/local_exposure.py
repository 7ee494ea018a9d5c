"""The exposure that photographs of a place have in the mean: in it a finished scene is drawn.

Training draws the scene as one exposure for all would show it, and photographs depart from that
(`model.exposure`): where a cloud passed, or fields are bright, all photographs of a place are darker or brighter
together. Pictures, maps and files of the scene follow them here, smoothly:

    D(p) = (Σ w_i(p) D_i S_i) (Σ w_i(p) S_i + w S)⁻¹,    w_i(p) = (1 - (a² + b²) / R²)² up to a² + b² = R², 0 beyond,

with D_i the departure of photograph i [3, 4]; a and b the place of p in it, from -1 to 1 between its sides; S_i the
mean of x xᵀ over its pixels, x being (color, 1), and S the mean of all S_i. So D(p) comes nearest to the departures of
the photographs, by least squares in their pixels (`training.exposure_centering`); beyond all photographs it is 0.
A color c is drawn as c + D(p) [c, 1]; what is behind the scene keeps its color.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int, Int32
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from vdgs.geometry.camera import Camera

#: Cells along the longer side of the grid: a photograph shows many of them (choice).
CELLS = 64
#: The grid reaches over so much of the anchors along x and y, which leaves out what is far away; beyond it the value at
#: its border holds.
INNER_SHARE = 0.98
#: R: photographs count for places up to so far from their middle, in halves of their sides (chosen on validation views:
#: experiments/reports/few-cameras.md).
REACH = 3.0
#: w: that of no departure, as a share of a photograph whose middle shows the place (choice).
PRIOR = 1e-3
#: Added to the diagonal of what is inverted, as a share of its trace, and so much alone: photographs in one color leave
#: D open, and where no pixel counts it is 0.
RIDGE, TINY = 1e-7, 1e-30
#: Places that are no farther along the axis of a camera, in units of the ground frame, are not before it.
_NEAREST = 1e-6


@dataclass(frozen=True, eq=False)
class LocalExposure:
    """D(p) on a grid of places x, y of the ground frame."""

    departures: Float[Tensor, "rows columns 3 4"]
    #: Of the first node of the grid, and between nodes, in units of the ground frame.
    x: float
    y: float
    spacing: float

    def at(self, places: Float[Tensor, "n 3"]) -> Float[Tensor, "12 n"]:
        """D of places, its rows one after the other: bilinear between the nodes; beyond the grid that of its border."""
        rows, columns = self.departures.shape[:2]
        i, above = _nodes((places[:, 1] - self.y) / self.spacing, rows)
        j, beside = _nodes((places[:, 0] - self.x) / self.spacing, columns)
        planes = self.departures.reshape(rows * columns, 12).T.contiguous()  # each is gathered and drawn by itself

        def along(row: Int32[Tensor, " n"]) -> Float[Tensor, "12 n"]:
            first, second = (row * columns + column for column in (j, (j + 1).clamp(max=columns - 1)))
            return _between(planes.index_select(1, first), planes.index_select(1, second), beside)

        return _between(along(i), along((i + 1).clamp(max=rows - 1)), above)

    def to(self, device: torch.device) -> LocalExposure:
        return replace(self, departures=self.departures.to(device))

    def check(self) -> None:
        """Raise ValueError unless the grid is one, of finite numbers."""
        shape, dtype = tuple(self.departures.shape), self.departures.dtype
        if len(shape) != 4 or shape[2:] != (3, 4) or not all(shape):
            raise ValueError(f"local exposure has shape {shape}, not [rows, columns, 3, 4]")
        if dtype != torch.float32:
            raise ValueError(f"local exposure is {dtype}, not torch.float32")
        placed = np.isfinite([self.x, self.y]).all() and 0 < self.spacing < np.inf
        if not (placed and bool(torch.isfinite(self.departures).all())):
            raise ValueError("local exposure holds numbers that are not finite")


def _nodes(places: Float[Tensor, " n"], count: int) -> tuple[Int32[Tensor, " n"], Float[Tensor, " n"]]:
    """The node before each place, and how far the place is from it."""
    places = places.clamp(0, count - 1)
    first = places.floor()
    return first.int(), places - first


def _between(first: Float[Tensor, "12 n"], second: Float[Tensor, "12 n"], share: Float[Tensor, " n"]) -> Tensor:
    """Linear; writes into both. In products and sums alone, here and below: `lerp` and sums over a dimension may round
    otherwise by where in a tensor a value stands, and so by the number of threads."""
    return first.mul_(1 - share).add_(second.mul_(share))


def apply_departures(
    colors: Float[Tensor, "m 3"], departures: Float[Tensor, "12 n"], of: Int[Tensor, " m"]
) -> Float[Tensor, "m 3"]:
    """c + D [c, 1] of colors c, each with the departure of the place that `of` counts. None is below 0: no file has
    such colors."""
    planes = [colors[:, channel].contiguous() for channel in range(3)]
    drawn = torch.empty_like(colors)
    for channel, plane in enumerate(planes):
        red, green, blue, constant = departures[4 * channel : 4 * channel + 4].index_select(1, of)
        sums = red.mul_(planes[0]).add_(green.mul_(planes[1])).add_(blue.mul_(planes[2])).add_(constant)
        drawn[:, channel] = sums.add_(plane).clamp_(min=0)
    return drawn


def fit_local_exposure(
    departures: Float[Tensor, "images 3 4"],
    color_moments: Float[Tensor, "images 4 4"],
    cameras: Sequence[Camera],
    positions: Float[Tensor, "n 3"],
    reach: float = REACH,
) -> LocalExposure:
    """D(p) of photographs, their S_i and their cameras, over the places of a scene's anchors."""
    x, y, spacing, places = _grid(positions.detach().cpu().double().numpy())
    of_image, moments = (each.detach().cpu().double().numpy() for each in (departures, color_moments))
    departed, of_colors = np.zeros((*places.shape[:2], 3, 4)), np.zeros((*places.shape[:2], 4, 4))
    for camera, departure, moment in zip(cameras, of_image, moments, strict=True):
        weight = _weights(camera, places, reach)[..., None, None]
        departed += weight * (departure @ moment)
        of_colors += weight * moment
    of_colors += PRIOR * moments.mean(axis=0)
    ridge = RIDGE * np.trace(of_colors, axis1=2, axis2=3) + TINY
    of_colors += ridge[..., None, None] * np.eye(4)
    # Both sides transposed: of_colors is symmetric.
    found = np.linalg.solve(of_colors, departed.swapaxes(2, 3)).swapaxes(2, 3)
    return LocalExposure(torch.from_numpy(np.ascontiguousarray(found)).float(), x, y, spacing)


def _weights(
    camera: Camera, places: Float[np.ndarray, "rows columns 3"], reach: float
) -> Float[np.ndarray, "rows columns"]:
    pixels, depths = camera.project(places.reshape(-1, 3))
    aside = ((2 * pixels / (camera.width, camera.height) - 1) ** 2).sum(axis=1) / reach**2
    weights = np.where((depths > _NEAREST) & (aside < 1), (1 - aside) ** 2, 0.0)
    return weights.reshape(places.shape[:2])


def _grid(positions: Float[np.ndarray, "n 3"]) -> tuple[float, float, float, Float[np.ndarray, "rows columns 3"]]:
    """x, y and spacing of a grid over anchors, and its nodes at the height that anchors near by have in the median."""
    low, high = np.quantile(positions[:, :2], [(1 - INNER_SHARE) / 2, (1 + INNER_SHARE) / 2], axis=0)
    spacing = float((high - low).max()) / CELLS or 1.0
    columns, rows = (np.floor((high - low) / spacing).astype(int) + 1).tolist()
    column, row = np.rint((positions[:, :2] - low) / spacing).clip(0, [columns - 1, rows - 1]).astype(int).T
    node, heights = row * columns + column, positions[:, 2]
    order = np.lexsort((heights, node))
    present, first, counts = np.unique(node[order], return_index=True, return_counts=True)
    z = np.full(rows * columns, np.nan)
    z[present] = heights[order][first + counts // 2]
    nearest = distance_transform_edt(np.isnan(z).reshape(rows, columns), return_distances=False, return_indices=True)
    z = z.reshape(rows, columns)[tuple(nearest)]
    x, y = low[0] + spacing * np.arange(columns), low[1] + spacing * np.arange(rows)
    return float(low[0]), float(low[1]), spacing, np.stack([*np.meshgrid(x, y), z], axis=-1)
