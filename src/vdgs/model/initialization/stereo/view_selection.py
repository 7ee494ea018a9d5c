"""Which photographs each one is compared with: near enough to be alike, far enough apart to tell depth.

A few neighbours that all lie to one side would leave the far side of a photograph alone, and what most photographs show
needs no help. So places count for less the more cameras see them, and partners are chosen greedily: each next one for
what those before it serve worst.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from scipy.spatial import cKDTree

from vdgs.geometry.camera import Camera
from vdgs.visibility.spatial_groups import Groups
from vdgs.visibility.visibility_counts import visibility_of

#: So many others for each photograph.
PARTNERS = 8
#: Degrees between the rays of two photographs to a point at which they tell its depth best: at less depth is vague, at
#: more pictures are less alike; the deviations of the two sides.
BEST_ANGLE, BELOW, ABOVE = 12.0, 4.0, 12.0
#: So many of the places that a photograph shows speak for it, and fewer than so many do not.
SPEAKERS, LEAST_SPEAKERS = 300, 8
#: Photographs that look at places nearest to one's own are asked: pairs of a large flight are too many to look at.
ASKED = 64
#: A partner must serve at least this share of what a photograph shows.
LEAST_SERVED = 0.01


def partners(cameras: Sequence[Camera], places: Float[np.ndarray, "n 3"], count: int = PARTNERS) -> list[list[int]]:
    """For each camera up to `count` others that see places of its picture from elsewhere, best first; none for one that
    shows hardly any. `places` are those of the whole flight, roughly. Deterministic."""
    views = visibility_of(torch.from_numpy(places), cameras).numpy()
    groups = Groups.of(torch.from_numpy(places))
    shown = [_speakers(held_by(camera, places, groups), views) for camera in cameras]
    centres = np.stack([camera.position for camera in cameras])
    seen = [index for index, mine in enumerate(shown) if len(mine) >= LEAST_SPEAKERS]
    found: list[list[int]] = [[] for _ in cameras]
    if len(seen) < 2:
        return found
    middles = np.stack([places[shown[index]].mean(0) for index in seen])
    _, near = cKDTree(middles).query(middles, k=min(ASKED, len(seen)), workers=1)
    for index, others in zip(seen, near, strict=True):
        asked = np.array([seen[other] for other in np.sort(others) if seen[other] != index], np.int64)
        mine = places[shown[index]]
        sees = np.stack([cameras[other].sees(mine) for other in asked])
        need = 1.0 / views[shown[index]]
        worth = _worth(centres[index], centres[asked], mine) * sees * (need / need.mean())
        found[index] = [int(asked[k]) for k in _greedily(worth, count)]
    return found


def held_by(camera: Camera, places: Float[np.ndarray, "n 3"], groups: Groups) -> Int64[np.ndarray, " s"]:
    """The places, of which `groups` are made, in a camera's picture, ascending; without a look at all of them."""
    near = groups.about(camera).numpy()
    return np.asarray(near[camera.sees(places[near])])


def _speakers(rows: Int64[np.ndarray, " n"], views: Int32[np.ndarray, " m"]) -> Int64[np.ndarray, " s"]:
    """At most `SPEAKERS` of the rows that are shown, each as likely as it is seldom seen."""
    if len(rows) <= SPEAKERS:
        return rows
    upto = np.cumsum(1.0 / views[rows])
    return rows[np.unique(np.searchsorted(upto, np.linspace(0, upto[-1] * (1 - 1e-9), SPEAKERS)))]


def _worth(
    own: Float[np.ndarray, "3"], others: Float[np.ndarray, "c 3"], points: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "c p"]:
    """What each other camera is worth for each point, 0 to 1: by the angle between the rays, and by how alike the
    distances are."""
    mine, theirs = points - own, points[None] - others[:, None]
    near, far = np.linalg.norm(mine, axis=-1), np.linalg.norm(theirs, axis=-1)
    cosine = (theirs * mine).sum(-1) / np.maximum(near * far, 1e-12)
    off = np.degrees(np.arccos(np.clip(cosine, -1, 1))) - BEST_ANGLE
    alike = np.minimum(near / np.maximum(far, 1e-12), far / np.maximum(near, 1e-12))
    worth: np.ndarray = alike * np.exp(-0.5 * (off / np.where(off < 0, BELOW, ABOVE)) ** 2)
    return worth


def _greedily(worth: Float[np.ndarray, "c p"], count: int) -> list[int]:
    """Rows that together serve all points: a point that is served asks less for more."""
    served, chosen = np.zeros(worth.shape[1]), list[int]()
    for _ in range(min(count, len(worth))):
        gain = (worth / (1 + 2 * served)).sum(1)
        gain[chosen] = -1.0
        best = int(gain.argmax())
        if gain[best] < LEAST_SERVED * worth.shape[1]:
            break
        chosen.append(best)
        served += worth[best]
    return chosen
