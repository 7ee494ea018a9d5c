"""Whether positions lie along one line, about which a scene could still turn."""

from __future__ import annotations

import numpy as np

from vdgs.captures.position_fit import ONE_LINE
from vdgs.geometry.similarity import is_collinear

#: Positions fix a turn about a line if they spread across it this many times their standard deviation.
MIN_SPREAD_SIGMAS = 3.0


def is_nearly_collinear(points: np.ndarray, std: np.ndarray) -> bool:
    """Whether places [n, 3] leave a turn about a line open: they spread across it no more than they may be wrong
    (standard deviations [n, 3])."""
    if is_collinear(points):
        return True
    return bool(_spread(points)[1] < MIN_SPREAD_SIGMAS * np.sqrt(np.median((std**2).mean(axis=1))))


def are_along_a_line(points: np.ndarray, stated: np.ndarray, found: np.ndarray) -> bool:
    """Whether places [n, 3] of a fit are along one line by the deviations that are stated of them [n, 3], unless they
    were found to be so much better [n, 3] that the line is plainly none: receivers of phones state many metres, and err
    by the same all along."""
    if not is_nearly_collinear(points, stated):
        return False
    spread = _spread(points)
    return bool(is_nearly_collinear(points, found) or spread[1] <= ONE_LINE * spread[0])


def _spread(points: np.ndarray) -> np.ndarray:
    """Root mean square along the main axes [3], the largest first."""
    return np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
