"""Fewer points where more would only cover each other."""

from __future__ import annotations

import numpy as np


def sample_points(points: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of the points [n, 3], drawn without replacement with a fixed seed."""
    if len(points) <= most:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), most, replace=False))]
