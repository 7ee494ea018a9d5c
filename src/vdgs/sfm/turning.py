"""Whether photographs show depth at all: of a camera that only turns, they do not.

Matches of two photographs that were taken from one place are explained by a rotation, whatever is seen. A mapper may
make a model of them nevertheless: with a wrong focal length and distortion the turn looks like parallax, and points lie
as near to where they are seen as in any other model. So the matches are asked: is there one lens by which rotations
alone explain nearly all of them? A flight over a plane is not explained so: what moves shifts all over the picture by
as much, what turns shifts more towards the edges, by a square that only an endless focal length would make vanish.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from vdgs.sfm.capture_writer import placed_images
from vdgs.sfm.reprojection import mean_reprojection_error
from vdgs.sfm.workspace import Workspace
from vdgs.system.lazy_pycolmap import pycolmap

#: So many pairs are looked at, so many matches of each, of the cameras that most photographs are of; pairs that fewer
#: matches verify say little (choices).
PAIRS, MATCHES, LEAST_MATCHES, CAMERAS = 150, 60, 15, 4
#: By a lens whose focal length is up to so many times longer or shorter than the model's, distorted up to so much more.
#: A longer one, or one that is bent more, would make a flight over a plane a turn (choices).
LONGER, BENT = 1.6, 0.2
#: A pair is explained where this share of its matches lies within so many mean reprojection errors of the model, and
#: within so many pixels whatever that is; photographs only turned where such a share of the pairs is (choices).
OF_MATCHES, ERRORS, LEAST_PX, OF_PAIRS = 0.8, 5.0, 0.5, 0.9
#: What matches are good for (pixels) where no model tells it (choice).
UNKNOWN_PX = 0.5
#: Steeper rays (tangent) of fisheyes are left out: lenses differ too much there (choice).
STEEPEST = 2.0
#: Distances of matches count in full up to so many pixels.
_SOFT_PX = 1.0
_STARTS = (0.0, -0.3, 0.3)


def only_turns(workspace: Workspace, model: pycolmap.Reconstruction | None = None) -> bool:
    """Whether rotations with one lens for each camera explain nearly all verified matches between the photographs that
    a model places (errors of points computed), or, without one, between all. False where too few match to tell."""
    found = _matches(workspace, model)
    if found is None:
        return False
    noise = UNKNOWN_PX if model is None else mean_reprojection_error(model)
    lenses = found.cameras.max() + 1
    lowest = np.repeat([-np.log(LONGER), -BENT], lenses)
    fits = [
        least_squares(
            lambda lens: found.apart(lens).ravel(),
            np.repeat([start, 0.0], lenses),
            bounds=(lowest, -lowest),
            loss="soft_l1",
            f_scale=_SOFT_PX,
            max_nfev=30,
        )
        for start in _STARTS
    ]
    apart = np.linalg.norm(found.apart(min(fits, key=lambda fit: fit.cost).x), axis=2)
    within = (apart <= max(LEAST_PX, ERRORS * noise)) & found.there
    return bool(np.mean(within.sum(axis=1) >= OF_MATCHES * found.there.sum(axis=1)) >= OF_PAIRS)


@dataclass(frozen=True, eq=False)
class _Matches:
    """Matches of p pairs, up to m of each. Of both photographs: `slopes` [2, p, m] of rays, tangents of what they are
    off the axis of the lens, and directions `around` it [2, p, m, 2], focal lengths `focals` in pixels and the numbers
    of their `cameras` [2, p]; which matches are `there` [p, m]."""

    slopes: np.ndarray
    around: np.ndarray
    focals: np.ndarray
    cameras: np.ndarray
    there: np.ndarray

    def apart(self, lens: np.ndarray) -> np.ndarray:
        """How far matches lie apart, in pixels [p, m, 3], once photographs are turned into each other as well as can
        be, by lenses [2 cameras]: logarithms of what slopes are multiplied by, and terms of more distortion. Distances
        are divided by what slopes were multiplied by, so that no lens makes all small."""
        longer, bent = (each[self.cameras][..., None] for each in lens.reshape(2, -1))
        slopes = self.slopes * np.exp(longer) * (1 + bent * self.slopes**2)
        rays = np.concatenate([slopes[..., None] * self.around, np.ones_like(slopes)[..., None]], axis=3)
        rays /= np.linalg.norm(rays, axis=3, keepdims=True)
        size = (self.focals / np.exp(longer[..., 0])).mean(axis=0)[:, None, None]
        weights = self.there.astype(float)
        for _ in range(2):  # the second time with what does not fit counting little
            apart = (_turned(rays[0], rays[1], weights) - rays[1]) * size * self.there[..., None]
            weights = self.there / (1 + (apart**2).sum(axis=2) / _SOFT_PX**2)
        return apart


def _turned(rays: np.ndarray, onto: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rays [p, m, 3] turned by the rotation of each pair that brings them nearest to others, by weights [p, m]."""
    left, _, right = np.linalg.svd(np.einsum("pm,pmi,pmj->pij", weights, onto, rays))
    sign = np.ones((len(rays), 3))
    sign[:, 2] = np.linalg.det(left @ right)
    return np.einsum("pij,pj,pjk,pmk->pmi", left, sign, right, rays)


def _of_each_photograph(pairs: Sequence[tuple[int, int]], rng: np.random.Generator) -> list[tuple[int, int]]:
    """So many pairs by chance, about as many of each photograph: where a camera turned on the spot for long all
    photographs match there, and hardly any pairs are of the flight."""
    left: dict[int, list[int]] = {}
    for k in rng.permutation(len(pairs)).tolist():
        for number in pairs[k]:
            left.setdefault(number, []).append(k)
    chosen, most = set[int](), min(PAIRS, len(pairs))
    while len(chosen) < most:
        for number in rng.permutation(sorted(left)).tolist():
            while left[number] and left[number][-1] in chosen:
                left[number].pop()
            if left[number] and len(chosen) < most:
                chosen.add(left[number].pop())
    return [pairs[k] for k in sorted(chosen)]


def _matches(workspace: Workspace, model: pycolmap.Reconstruction | None) -> _Matches | None:
    """Matches of pairs by chance, the same each time; None where there are none to look at."""
    with workspace.open_database() as database:
        known = {image.image_id: image for image in database.read_all_images()}
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        used = set(known)
        if model is not None:
            cameras.update(model.cameras)
            names = {image.name for image in placed_images(model)}
            used = {number for number, image in known.items() if image.name in names}
        owners = Counter(known[number].camera_id for number in used)
        places = {camera: k for k, (camera, _) in enumerate(owners.most_common(CAMERAS))}
        used = {number for number in used if known[number].camera_id in places}
        numbers, counts = database.read_two_view_geometry_num_inliers()
        pairs = [
            pair
            for pair, count in zip(map(pycolmap.pair_id_to_image_pair, numbers), counts, strict=True)
            if count >= LEAST_MATCHES
            and used.issuperset(pair)
            and known[pair[0]].frame_id != known[pair[1]].frame_id  # those of a rig are of one place anyway
        ]
        rng = np.random.default_rng(0)
        pairs = _of_each_photograph(pairs, rng)
        if not pairs:
            return None
        rays, there = np.zeros((2, len(pairs), MATCHES, 2)), np.zeros((len(pairs), MATCHES), bool)
        for k, pair in enumerate(pairs):
            matches = database.read_two_view_geometry(*pair).inlier_matches
            matches = matches[rng.permutation(len(matches))[:MATCHES]]
            there[k, : len(matches)] = True
            for side, number in enumerate(pair):
                marks = database.read_keypoints(number)[matches[:, side], :2].astype(np.float64)
                rays[side, k, : len(matches)] = cameras[known[number].camera_id].cam_from_img(marks)
        owner = [[known[pair[side]].camera_id for pair in pairs] for side in range(2)]
    there &= (np.linalg.norm(rays, axis=3) < STEEPEST).all(axis=0)  # nor what a fisheye sees behind it: NaN
    rays[:, ~there] = 0.0
    radius = np.linalg.norm(rays, axis=3)
    return _Matches(
        slopes=radius,
        around=rays / np.maximum(radius, 1e-12)[..., None],
        focals=np.array([[cameras[number].mean_focal_length() for number in row] for row in owner]),
        cameras=np.array([[places[number] for number in row] for row in owner]),
        there=there,
    )
