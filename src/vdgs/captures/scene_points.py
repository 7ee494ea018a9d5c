"""The part of the sparse points that photographs show well, and how finely they show it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from vdgs.captures.capture import Capture
from vdgs.geometry.similarity import sample_points
from vdgs.visibility.visibility_counts import count_visibility

#: The scene are the points that so many training cameras see. What lies so many times farther from every camera than
#: the median point is what they see behind the scene, with pixels as many times larger (choice).
MIN_SEEN_BY, MAX_DISTANCE_RATIO = 2, 4.0
#: Cameras by which the ground sampling distance is found.
_MAX_GSD_CAMERAS = 60


def scene_points(capture: Capture, max_points: int | None = None) -> Float[np.ndarray, "n 3"]:
    """The sparse points [n, 3] that at least two training photographs show, without the background; of `max_points`
    of them if given."""
    cameras = [view.camera for view in capture.train_views]
    points = capture.points if max_points is None else sample_points(capture.points, max_points)
    seen = count_visibility(torch.from_numpy(points), cameras).numpy()
    shown = points[seen >= min(MIN_SEEN_BY, len(cameras))]
    return shown[_not_in_background(shown, np.array([camera.position for camera in cameras]))]


def _not_in_background(points: Float[np.ndarray, "n 3"], cameras: Float[np.ndarray, "c 3"]) -> Bool[np.ndarray, " n"]:
    """Which points are of the scene, and not of what cameras see behind it."""
    distance = cKDTree(cameras).query(points, workers=1)[0]
    return np.asarray(distance <= MAX_DISTANCE_RATIO * np.median(distance)) if len(points) else np.ones(0, bool)


def ground_sampling_distance(capture: Capture) -> float | None:
    """The median size of a pixel of the training photographs on what they show, in units of the ground frame; None
    where no photograph holds a sparse point."""
    views = capture.train_views
    sizes = []
    for index in np.unique(np.linspace(0, len(views) - 1, _MAX_GSD_CAMERAS).round().astype(int)):
        camera = views[index].camera
        held = camera.in_frustum(capture.points)
        if held.any():
            sizes.append(float(np.median(camera.project(capture.points[held])[1])) / camera.fx)
    return float(np.median(sizes)) if sizes else None
