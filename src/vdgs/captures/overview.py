"""From where all of a flight is seen: the first view of whoever opens a scene."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from vdgs.captures.camera_height import camera_height
from vdgs.captures.capture import Capture

#: Vertical angle of view of a first look (choice).
FOV_DEG = 50.0


class Overview(NamedTuple):
    """Where to stand and what to look at, ground frame; z is up."""

    position: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]


def overview(capture: Capture) -> Overview:
    """All of the flight from the south, half from above."""
    middle, half = _extent(capture)
    distance = max(1.5 * camera_height(capture), 1.3 * half / math.tan(math.radians(FOV_DEG / 2)))
    return Overview(middle + distance * np.array([0.0, -math.sqrt(0.5), math.sqrt(0.5)]), middle)


def _extent(capture: Capture) -> tuple[Float[np.ndarray, "3"], float]:
    """The middle of what was flown over, on the ground, and half its longer side."""
    flown = np.stack([view.camera.position for view in capture.train_views])[:, :2]
    low, high = np.quantile(flown, (0.05, 0.95), axis=0)
    ground = float(np.median(capture.points[:, 2])) if len(capture.points) else 0.0
    return np.append((low + high) / 2, ground), max(float((high - low).max()) / 2, camera_height(capture) / 2)
