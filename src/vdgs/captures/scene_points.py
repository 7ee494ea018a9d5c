"""The part of the sparse points that photographs show well, and how finely they show it."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from vdgs.captures.capture import Capture, spread_evenly
from vdgs.geometry.similarity import sample_points
from vdgs.visibility.visibility_counts import count_visibility

#: The scene are the points that so many training cameras see. What lies so many times farther from every camera than
#: the median point is what they see behind the scene, with pixels as many times larger (choice).
MIN_SEEN_BY, MAX_DISTANCE_RATIO = 2, 4.0
#: Cameras by which the ground sampling distance is found.
_MAX_GSD_CAMERAS = 60


def scene_points(
    capture: Capture,
    max_points: int | None = None,
    min_seen_by: int = MIN_SEEN_BY,
    about: tuple[Float[np.ndarray, "3"], float] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """The sparse points [n, 3] that at least so many training cameras see, without the background; of those in a sphere
    `about` a place (which, radius), and of `max_points` of them, if given."""
    cameras = [view.camera for view in capture.train_views]
    points = capture.points
    if about is not None:
        points = points[np.linalg.norm(points - about[0], axis=1) <= about[1]]
    points = points if max_points is None else sample_points(points, max_points)
    if not len(points):
        return points
    seen = count_visibility(torch.from_numpy(points), cameras).numpy()
    shown = points[seen >= min(min_seen_by, len(cameras))]
    if not len(shown):
        return shown
    distance = cKDTree([camera.position for camera in cameras]).query(shown, workers=1)[0]
    return shown[distance <= MAX_DISTANCE_RATIO * np.median(distance)]


def ground_sampling_distance(capture: Capture) -> float | None:
    """The median size of a pixel of the training photographs on what they show, in units of the ground frame; None
    where no photograph holds a sparse point."""
    sizes = []
    for camera in (view.camera for view in spread_evenly(capture.train_views, _MAX_GSD_CAMERAS)):
        held = camera.in_frustum(capture.points)
        if held.any():
            sizes.append(float(np.median(camera.project(capture.points[held])[1])) / camera.fx)
    return float(np.median(sizes)) if sizes else None
