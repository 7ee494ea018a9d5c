"""Levels of anchors: a view draws those that are fine enough for its pixels, and all coarser ones (Octree-GS, Ren et
al., TPAMI 2025, sections 4.1 and 4.2).

Octree-GS chooses by distance; the size of a pixel is the distance in a flight with one lens, and makes a photograph
that training shrinks what a photograph from farther away is. An anchor does not keep its level's number but the largest
pixel in which it is drawn (`Anchors.max_pixels`): models of several blocks and parts of a model need nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels import get_backend
from vdgs.model.anchors import Anchors

#: Share of the views that are nearer, and that are farther, than what levels are made for (choice).
OUTER_SHARE = 0.1
#: Points that say how large pixels are.
MAX_POINTS = 10_000
#: Levels are at most so many, and where nobody said how many at least so many, or one (choice: two lost 0.6 dB on a
#: flight of one height that looks far out).
MAX_LEVELS, MIN_AUTO_LEVELS = 16, 3


def pixel_sizes(positions: Float[Tensor, "p 3"], camera: Camera) -> Float[Tensor, " p"]:
    """How much of the scene a pixel shows at each place, in units of the ground frame. It does not depend on where the
    camera looks."""
    focal = max(camera.fx, camera.fy)
    if camera.model == "orthographic":
        return torch.full_like(positions[:, 0], 1.0 / focal)
    return (positions - torch.as_tensor(camera.position, device="cpu").to(positions)).norm(dim=1) / focal


def fit_levels(points: Float[np.ndarray, "p 3"], cameras: Sequence[Camera], count: int) -> tuple[float, ...]:
    """The largest pixel of each level, finest first, each twice the one before; infinite for the coarsest.

    The finest level is for the cameras with the smallest pixels, at the median of the points that they hold. A level is
    drawn in pixels of up to √2 times the size that it is for. `count` 0: as many as the coarsest pixels ask for, if
    three or more. One level: empty.
    """
    if count == 1 or not len(points):
        return ()
    places = torch.from_numpy(points[:: -(-len(points) // MAX_POINTS)].astype(np.float32))
    kernels = get_backend(places.device)
    held = [pixel_sizes(places[kernels.mark_visible(places, camera)], camera) for camera in cameras]
    medians = [float(sizes.median()) for sizes in held if len(sizes)]
    if not medians:
        return ()
    finest, coarsest = np.quantile(medians, [OUTER_SHARE, 1 - OUTER_SHARE]).tolist()
    if not count:
        count = min(round(math.log2(coarsest / finest)) + 1, MAX_LEVELS)
        count = count if count >= MIN_AUTO_LEVELS else 1
    # As float32 numbers: anchors are known by them.
    finite = [float(np.float32(finest * 2.0 ** (level + 0.5))) for level in range(count - 1)]
    return (*finite, math.inf) if count > 1 else ()


def add_coarser_levels(anchors: Anchors, voxel: float, max_pixels: Sequence[float]) -> Anchors:
    """The anchors as the finest level, and after them an anchor in each cell of each coarser level that holds one, of
    the mean feature. The cells of a level are twice as large as those of the level before, `voxel` for the finest."""
    levels, voxels = [_with_max_pixels(anchors, max_pixels[0])], np.round(anchors.positions.double().numpy() / voxel)
    for level, largest in enumerate(max_pixels[1:], 1):
        cell = voxel * 2.0**level
        # Halves are rounded up, as those of cells in which anchors grow.
        cells, member = np.unique(np.floor(voxels / 2.0**level + 0.5), axis=0, return_inverse=True)
        index, places = torch.from_numpy(member.reshape(-1)), torch.from_numpy((cells * cell).astype(np.float32))
        features = places.new_zeros(len(places), anchors.features.shape[1]).index_add_(0, index, anchors.features)
        features /= torch.bincount(index, minlength=len(places))[:, None]
        log_scales = torch.from_numpy(mean_spacing(cells * cell, cell).astype(np.float32)).log()[:, None].repeat(1, 6)
        offsets = anchors.offsets.new_zeros(len(places), *anchors.offsets.shape[1:])
        levels.append(_with_max_pixels(Anchors(places, features, offsets, log_scales), largest))
    return Anchors(**{name: torch.cat([each.tensors()[name] for each in levels]) for name in levels[0].tensors()})


def level_sizes(anchors: Anchors) -> tuple[float, ...]:
    """The largest pixel of each level that the anchors have, finest first; empty without levels."""
    return () if anchors.max_pixels is None else tuple(anchors.max_pixels.unique().tolist())


def describe_levels(anchors: Anchors) -> str:
    """How many anchors each level has, in a sentence for the console."""
    assert anchors.max_pixels is not None
    counts = [(largest, int((anchors.max_pixels == largest).sum())) for largest in level_sizes(anchors)]
    parts = [f"{n:,} anchors " + (f"in pixels up to {m:.3g}" if m < math.inf else "in all") for m, n in counts]
    return "levels: " + ", ".join(parts)


def mean_spacing(positions: Float[np.ndarray, "n 3"], voxel: float) -> Float[np.ndarray, " n"]:
    """Mean distance of places to their three nearest others, at least half a voxel; a voxel for a single place."""
    if len(positions) < 2:
        return np.full(len(positions), voxel)
    distances, _ = cKDTree(positions).query(positions, k=min(4, len(positions)), workers=1)
    return np.clip(distances[:, 1:].mean(axis=1), 0.5 * voxel, None)


def _with_max_pixels(anchors: Anchors, largest: float) -> Anchors:
    return replace(anchors, max_pixels=torch.full_like(anchors.positions[:, 0], largest))
