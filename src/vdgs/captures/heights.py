"""How high cameras fly: the length that makes settings mean the same in any unit."""

from __future__ import annotations

import numpy as np

from vdgs.captures.capture import Capture


def camera_height(capture: Capture) -> float:
    """Median height of the training cameras above the median sparse point; at least a thousandth of their spread."""
    centres = np.array([view.camera.position for view in capture.train_views])
    height = float(np.median(centres[:, 2]) - np.median(capture.points[:, 2]))
    return max(height, 1e-3 * float(np.ptp(capture.points, axis=0).max()), 1e-9)
