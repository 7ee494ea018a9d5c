"""What is torn in a view: needles (splats seen as lines) and floaters (what hangs before the true surface). Both grow
away from the path of the flight, where no photograph corrects them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from vdgs.evaluation.by_block import MIN_ALPHA
from vdgs.evaluation.by_visibility import mean_or_none
from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import DILATION_PX2
from vdgs.kernels.kernel_types import Splats
from vdgs.model.renderer import rasterize_splats
from vdgs.visibility.visibility_counts import NearbyCameras

#: A splat is a needle where its standard deviation across (pixels, before the blur of a pixel) is below the first, or
#: that along it is more than the second times as long. Shorter ones than the third are dots.
NEEDLE_WIDTH_PX, NEEDLE_RATIO, DOT_PX = 0.1, 10.0, 0.5
#: A pixel shows a floater where its median depth is more than this share of the camera height before the truth.
FLOATER_THRESHOLD = 0.02
#: Angles are computed at so many pixels of a view at most, evenly spread.
MAX_ANGLE_PIXELS = 20_000
#: So many of them, across and down, are asked of the training cameras that reach them.
PATCH_SIDE = 36
#: Bins by angle (degrees) end below these; the last one is open.
ANGLE_EDGES = (10.0, 20.0, 40.0)
ARTIFACT_KEYS = ("needles", "floaters")


@torch.no_grad()
def needle_share(splats: Splats, camera: Camera) -> float | None:
    """The share of what a view draws (summed alpha) that needles draw; None where nothing is drawn."""
    a, b, c = splats.conics.double().unbind(dim=1)
    middle, radius = (a + c) / 2, torch.hypot((a - c) / 2, b)
    # The inverse conic is the covariance; its larger eigenvalue from the determinant, as in `count_oversized_splats`.
    along = ((middle + radius) / (a * c - b * b) - DILATION_PX2).clamp(min=0).sqrt()
    across = (1.0 / (middle + radius) - DILATION_PX2).clamp(min=0).sqrt()
    needle = (along > DOT_PX) & ((across < NEEDLE_WIDTH_PX) | (along > NEEDLE_RATIO * across))
    gray = replace(splats, colors=needle.to(splats.colors)[:, None].expand(-1, 3).contiguous())
    drawn = rasterize_splats(gray, camera, splats.means_px.new_zeros(3))
    total = float(drawn.alpha.sum())
    return float(drawn.image[..., 0].sum()) / total if total > 0 else None


def floater_share(
    depth: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"], true_depth: Float[np.ndarray, "h w"],
    camera_height: float,
) -> float:  # fmt: skip
    """The share of pixels whose depth is that of a floater; before the sky (infinite) all that is drawn is one."""
    return float(((alpha > MIN_ALPHA) & (depth < true_depth - FLOATER_THRESHOLD * camera_height)).mean())


def summarize_artifacts(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Means over the views."""
    return {name: mean_or_none([row.get(name) for row in rows]) for name in ARTIFACT_KEYS}


def training_view_angles(
    camera: Camera, depth: Float[np.ndarray, "h w"], cameras: Sequence[Camera]
) -> Float[np.ndarray, "h w"]:
    """The angle in degrees, at the place that a pixel shows, between its view and the nearest of those training cameras
    whose picture the place lies in (without occlusion, as in V); 180 where it lies in none, NaN where nothing is shown.
    """
    step = max(1, int(np.ceil(np.sqrt(depth.size / MAX_ANGLE_PIXELS))))
    some = np.zeros(depth.shape, bool)
    some[step // 2 :: step, step // 2 :: step] = True
    some &= np.isfinite(depth)
    places = camera.unproject(np.where(np.isfinite(depth), depth, 1.0))
    angles, nearby, side = np.full(depth.shape, np.nan), NearbyCameras(cameras), step * PATCH_SIDE
    for top, left in product(range(0, depth.shape[0], side), range(0, depth.shape[1], side)):
        patch = np.s_[top : top + side, left : left + side]
        shown = places[patch][some[patch]]
        # Of thousands of cameras a few dozen reach what a patch shows.
        angles[patch][some[patch]] = _least_angles(camera, shown, nearby.of(torch.from_numpy(shown)))
    return angles


def _least_angles(
    camera: Camera, places: Float[np.ndarray, "n 3"], cameras: Sequence[Camera]
) -> Float[np.ndarray, " n"]:
    """The angle in degrees at each place between a camera and the nearest of others that hold it; 180 without any."""
    toward = _unit(camera.position - places)
    best = np.full(len(places), -1.0)
    for other in cameras:
        held = np.flatnonzero(other.in_frustum(places))
        cosine = (toward[held] * _unit(other.position - places[held])).sum(axis=1)
        best[held] = np.maximum(best[held], cosine)
    return np.degrees(np.arccos(np.clip(best, -1.0, 1.0)))


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
