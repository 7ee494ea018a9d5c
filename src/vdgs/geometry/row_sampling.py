"""Fewer points where more would only cover each other."""

from __future__ import annotations

import numpy as np


def sample_points(points: np.ndarray, max_points: int) -> np.ndarray:
    """At most `most` of the points [n, 3], drawn without replacement with a fixed seed."""
    if len(points) <= max_points:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), max_points, replace=False))]
