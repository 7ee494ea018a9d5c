"""Where to stand for a first look: the whole scene in the picture, from a direction that the photographs support."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture, spread_evenly
from vdgs.captures.scene_points import MIN_SEEN_BY, scene_points
from vdgs.geometry.similarity import sample_points
from vdgs.geometry.view_convergence import Convergence, find_convergence

#: Vertical angle of view of a first look (choice).
FOV_DEG = 50.0
#: The scene, without this share of its points on every side, fills this share of the picture's height, and as many
#: pixels across: a panel fits beside the scene in a wide window.
_TRIM_QUANTILE, _FILLED_SHARE = 0.003, 0.8
#: Points by which the scene is found, points and cameras by which directions are compared.
_MAX_SCENE_POINTS, _MAX_POINTS, _MAX_CAMERAS = 5000, 300, 60
#: Fewer points say nothing of where the scene is.
_MIN_POINTS = 10
#: The picture is framed by the points that so many training cameras see, where these are the half of all.
_TRUSTED_SEEN_BY = 3
#: Directions that are compared, in degrees.
_ELEVATIONS_DEG, _AZIMUTHS_DEG = (5, 12, 20, 30, 40, 50, 60, 70, 80), range(0, 360, 15)
#: A place this many degrees from the nearest camera is as good as the camera's own. What a direction costs beside the
#: degrees beyond: each that it is steeper or flatter than half from above, and each that it is turned from north, which
#: is up on maps (choice).
_SUPPORTED_DEG, _OBLIQUE_DEG, _COST_OF_ELEVATION, _COST_OF_AZIMUTH = 15.0, 45.0, 0.5, 0.06
#: The first look stands at least this share of its distance above the ground (choice).
_MIN_HEIGHT_SHARE = 0.03


class DefaultView(NamedTuple):
    """Where to stand and what to look at, ground frame; z is up."""

    position: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]


def default_view(capture: Capture, whole: bool = False) -> DefaultView:
    """What at least three training cameras see of the scene, seen half from above where cameras looked that way, else
    from the nearest direction in which cameras looked: the direction of the least cost (`_COST_OF_ELEVATION`). Where
    their views converge on a place (`geometry.view_convergence`), of that what is about it, unless the `whole` is
    asked for."""
    converged = None if whole else find_convergence([view.camera for view in capture.train_views])
    points = _trimmed(_shown(capture, converged))
    if converged is not None and len(points) < _MIN_POINTS:
        points = _trimmed(_shown(capture, None))
    if len(points) < _MIN_POINTS:
        points = capture.points if len(capture.points) else np.zeros((1, 3))
    support = _Support(capture, sample_points(points, _MAX_POINTS))
    nearest = 0.5 * camera_height(capture)
    ground = float(np.quantile(points[:, 2], _TRIM_QUANTILE))
    middle, points = np.median(points, axis=0), _outline(points)
    best, least = None, math.inf
    for elevation in (sign * each for sign in support.signs for each in _ELEVATIONS_DEG):
        for azimuth in _AZIMUTHS_DEG:
            look = _framed(points, middle, _direction(azimuth, elevation), nearest)
            above = float(look.position[2]) - ground
            if elevation > 0 and above < _MIN_HEIGHT_SHARE * float(np.linalg.norm(look.position - look.target)):
                continue
            cost = support.missing_deg(look.position) + _COST_OF_ELEVATION * abs(abs(elevation) - _OBLIQUE_DEG)
            cost += _COST_OF_AZIMUTH * min(azimuth, 360 - azimuth)
            if cost < least - 1e-9:
                best, least = look, cost
    assert best is not None  # from 80 degrees every look is above the ground
    return best


def _shown(capture: Capture, converged: Convergence | None) -> Float[np.ndarray, "n 3"]:
    """The points that the picture is to hold."""
    about = None if converged is None else (converged.place, converged.radius)
    known, trusted = (scene_points(capture, _MAX_SCENE_POINTS, seen, about) for seen in (MIN_SEEN_BY, _TRUSTED_SEEN_BY))
    return trusted if 2 * len(trusted) >= len(known) else known


class _Support:
    """From which directions cameras see points."""

    def __init__(self, capture: Capture, points: Float[np.ndarray, "n 3"]) -> None:
        cameras = [view.camera for view in spread_evenly(capture.train_views, _MAX_CAMERAS)]
        toward = np.stack([camera.position - points for camera in cameras])
        self._toward = toward / np.maximum(np.linalg.norm(toward, axis=2, keepdims=True), 1e-12)  # [c, n, 3]
        self._seen = np.stack([camera.in_frustum(points) for camera in cameras])
        if not self._seen.any():
            self._seen[:] = True
        self._points = points
        #: Above the scene; below it too where the cameras are: an up axis that was estimated may be wrong.
        self.signs = (1,) if np.median(self._toward[..., 2][self._seen]) > -0.1 else (1, -1)

    def missing_deg(self, position: Float[np.ndarray, "3"]) -> float:
        """By how many degrees beyond `_SUPPORTED_DEG` points, on average, see a place and the nearest camera that sees
        them apart."""
        ray = position - self._points
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
        cosine = np.where(self._seen, np.einsum("cnk,nk->cn", self._toward, ray), -2.0).max(axis=0)
        apart = np.degrees(np.arccos(cosine[cosine > -2].clip(-1, 1)))
        return float(np.maximum(apart - _SUPPORTED_DEG, 0).mean())


def _trimmed(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Points without the outermost of every axis."""
    if not len(points):
        return points
    low, high = np.quantile(points, (_TRIM_QUANTILE, 1 - _TRIM_QUANTILE), axis=0)
    return points[((points >= low) & (points <= high)).all(axis=1)]


def _outline(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The corners of the convex hull of points: a picture that holds the corners holds all points."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # all in a plane, or too few
        return points


def _direction(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3"]:
    """The unit vector from the scene to the viewer; at azimuth 0 the viewer stands in the south and looks north."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    level = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0]) * math.cos(elevation)
    return level + np.array([0.0, 0.0, math.sin(elevation)])


def _framed(
    points: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"], nearest: float
) -> DefaultView:
    """The look from a direction, and no nearer to the middle than `nearest`, whose picture the points fill."""
    right = np.cross((0.0, 0.0, 1.0), direction)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(direction, right), direction])  # right, up and backwards of the picture
    local, slope = points @ axes.T, _FILLED_SHARE * math.tan(math.radians(FOV_DEG / 2))
    # |across - stand| <= slope (stand's backwards - backwards) for all points.
    high = (local[:, :2] + slope * local[:, 2:]).max(axis=0)
    low = (local[:, :2] - slope * local[:, 2:]).min(axis=0)
    depth = float(middle @ direction)
    backwards = max(float((high - low).max()) / (2 * slope), depth + nearest)
    across = (high + low) / 2
    return DefaultView(np.append(across, backwards) @ axes, np.append(across, depth) @ axes)
