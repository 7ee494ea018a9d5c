"""Source views of each photograph: near enough to look alike, far enough apart to measure depth.

Points count for less the more cameras see them, and views are chosen greedily, each for the points that the earlier
ones cover worst, so that they do not all lie to one side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from scipy.spatial import cKDTree

from vdgs.geometry.camera import Camera
from vdgs.visibility.spatial_groups import SpatialGroups
from vdgs.visibility.visibility_counts import count_visibility

#: So many others for each photograph.
NUM_SOURCE_VIEWS = 8
#: Degrees between the rays of two photographs to a point at which they tell its depth best: at less depth is vague, at
#: more pictures are less alike; the deviations of the two sides.
BEST_ANGLE_DEG, SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG = 12.0, 4.0, 12.0
#: So many of the places that a photograph shows speak for it, and fewer than so many do not.
NUM_SAMPLE_POINTS, MIN_SAMPLE_POINTS = 300, 8
#: Photographs that look at places nearest to one's own are candidates: pairs of a large flight are too many to look at.
MAX_CANDIDATES = 64
#: A partner must serve at least this share of what a photograph shows.
MIN_COVERAGE_GAIN = 0.01


def select_source_views(
    cameras: Sequence[Camera], points: Float[np.ndarray, "n 3"], count: int = NUM_SOURCE_VIEWS
) -> list[list[int]]:
    """For each camera up to `count` others that see places of its picture from elsewhere, best first; none for one that
    shows hardly any. `points` are those of the whole flight, roughly. Deterministic."""
    views = count_visibility(torch.from_numpy(points), cameras).numpy()
    groups = SpatialGroups.of(torch.from_numpy(points))
    shown = [_sample_points(points_in_view(camera, points, groups), views) for camera in cameras]
    centers = np.stack([camera.position for camera in cameras])
    seen = [index for index, mine in enumerate(shown) if len(mine) >= MIN_SAMPLE_POINTS]
    found: list[list[int]] = [[] for _ in cameras]
    if len(seen) < 2:
        return found
    middles = np.stack([points[shown[index]].mean(0) for index in seen])
    _, near = cKDTree(middles).query(middles, k=min(MAX_CANDIDATES, len(seen)), workers=1)
    for index, others in zip(seen, near, strict=True):
        candidates = np.array([seen[other] for other in np.sort(others) if seen[other] != index], np.int64)
        mine = points[shown[index]]
        sees = np.stack([cameras[other].in_frustum(mine) for other in candidates])
        need = 1.0 / views[shown[index]]
        worth = _view_score(centers[index], centers[candidates], mine) * sees * (need / need.mean())
        found[index] = [int(candidates[k]) for k in _greedily(worth, count)]
    return found


def points_in_view(camera: Camera, points: Float[np.ndarray, "n 3"], groups: SpatialGroups) -> Int64[np.ndarray, " s"]:
    """The places, of which `groups` are made, in a camera's picture, ascending; without a look at all of them."""
    near = groups.query_frustum(camera).numpy()
    return np.asarray(near[camera.in_frustum(points[near])])


def _sample_points(rows: Int64[np.ndarray, " n"], views: Int32[np.ndarray, " m"]) -> Int64[np.ndarray, " s"]:
    """At most `NUM_SAMPLE_POINTS` of the rows that are shown, each as likely as it is seldom seen."""
    if len(rows) <= NUM_SAMPLE_POINTS:
        return rows
    upto = np.cumsum(1.0 / views[rows])
    return rows[np.unique(np.searchsorted(upto, np.linspace(0, upto[-1] * (1 - 1e-9), NUM_SAMPLE_POINTS)))]


def _view_score(
    own: Float[np.ndarray, "3"], others: Float[np.ndarray, "c 3"], points: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "c p"]:
    """What each other camera is worth for each point, 0 to 1: by the angle between the rays, and by how alike the
    distances are."""
    mine, theirs = points - own, points[None] - others[:, None]
    near, far = np.linalg.norm(mine, axis=-1), np.linalg.norm(theirs, axis=-1)
    cosine = (theirs * mine).sum(-1) / np.maximum(near * far, 1e-12)
    off = np.degrees(np.arccos(np.clip(cosine, -1, 1))) - BEST_ANGLE_DEG
    alike = np.minimum(near / np.maximum(far, 1e-12), far / np.maximum(near, 1e-12))
    worth: np.ndarray = alike * np.exp(-0.5 * (off / np.where(off < 0, SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG)) ** 2)
    return worth


def _greedily(worth: Float[np.ndarray, "c p"], count: int) -> list[int]:
    """Rows that together serve all points: a point that is served asks less for more."""
    served, chosen = np.zeros(worth.shape[1]), list[int]()
    for _ in range(min(count, len(worth))):
        gain = (worth / (1 + 2 * served)).sum(1)
        gain[chosen] = -1.0
        best = int(gain.argmax())
        if gain[best] < MIN_COVERAGE_GAIN * worth.shape[1]:
            break
        chosen.append(best)
        served += worth[best]
    return chosen
