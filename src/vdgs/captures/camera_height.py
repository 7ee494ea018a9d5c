"""How high cameras fly: the length that makes settings mean the same in any unit.

Cameras on a tower, a hillside or in a street fly at no height: half of what they see lies above them. How far they
are from it takes the place of the height then, for the scale of the ground frame as for settings.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from jaxtyping import Float

from vdgs.captures.capture import Capture
from vdgs.config.method import TrainConfig
from vdgs.geometry.camera import Camera
from vdgs.geometry.similarity import geometric_median

#: Cameras fly at several heights where all but the lowest and highest 5 % of them differ by more than this share of the
#: median (choice: more than a flight along one height over hills).
SEVERAL_HEIGHTS_SHARE = 0.25
#: Cameras that are no higher above the points than this share of their distance to them fly at no height (choice).
MIN_HEIGHT_RATIO = 0.02


class ViewDistance(NamedTuple):
    """A typical distance from cameras to what they see; whether it is their height above the points."""

    length: float
    is_height: bool


def view_distance(
    centers: Float[np.ndarray, "c 3"], points: Float[np.ndarray, "p 3"], up: Float[np.ndarray, "3"]
) -> ViewDistance:
    """Median height of the cameras above the median point along `up`, a unit vector; where there is none to speak of,
    the median distance of the cameras to the geometric median of the points. 0 if all lies in one place."""
    height = float(np.median(centers @ up) - np.median(points @ up))
    distance = float(np.median(np.linalg.norm(centers - geometric_median(points), axis=1)))
    return ViewDistance(height, True) if height > MIN_HEIGHT_RATIO * distance else ViewDistance(distance, False)


def height_range(heights: npt.ArrayLike) -> tuple[float, float] | None:
    """The lowest and the highest of heights [n], without 5 % on each side; None where one height, their median, says
    it all."""
    values = np.asarray(heights, np.float64)
    if not len(values):
        return None
    low, high = (float(each) for each in np.quantile(values, (0.05, 0.95), method="nearest"))
    return (low, high) if high - low > SEVERAL_HEIGHTS_SHARE * abs(float(np.median(values))) else None


def offset_rate_factor(capture: Capture, config: TrainConfig) -> float:
    """What the rates of offsets are multiplied by: 1, or with `lr_offsets_unit` cameras the "extent" of 3DGS and
    Scaffold-GS: 1.1 times the largest distance of a training camera to their mean, in the capture's own units."""
    if config.lr_offsets_unit == "anchor":
        return 1.0
    centers = np.array([view.camera.position for view in capture.train_views])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()) / capture.ground.scale


def pixel_at_camera_height(height: float, cameras: Iterable[Camera]) -> float:
    """Side of what a pixel of the training photographs shows from so far away (`camera_height`), at the median of
    their focal lengths."""
    return height / float(np.median([max(camera.fx, camera.fy) for camera in cameras]))


def camera_height(capture: Capture) -> float:
    """How high the training cameras fly above the sparse points, or where they do not, how far they are from them
    (`view_distance`); above 0 in any case."""
    centers = np.array([view.camera.position for view in capture.train_views])
    return max(view_distance(centers, capture.points, np.array([0.0, 0.0, 1.0])).length, 1e-9)
