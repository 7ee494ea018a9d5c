"""How cameras look in a world with z up, and whether they look up as only those of a world upside down do."""

from __future__ import annotations

import numpy as np

#: Views that look up by more than this from straight down (degrees, median) are of nothing that flies over ground, and
#: nor are those by more than the second whose upper sides point down by so much (cosine, median; choice).
UPWARDS_DEG, UPWARDS_TURNED_DEG, TURNED_OVER = 150.0, 105.0, -0.25


def tilt_of_views(rotations: np.ndarray) -> float:
    """Angle in degrees (median) between the views of cameras [n, 3, 3] and straight down, in a world with z up."""
    return float(np.median(np.degrees(np.arccos(np.clip(-rotations[:, 2, 2], -1, 1)))))


def are_turned_over(rotations: np.ndarray) -> bool:
    """Whether cameras [n, 3, 3] in a world with z up look up as only those of a world do that is upside down, or those
    under a ceiling: nearly straight, or with their upper sides down."""
    tilt, upper_sides = tilt_of_views(rotations), float(np.median(-rotations[:, 1, 2]))
    return tilt > UPWARDS_DEG or (tilt > UPWARDS_TURNED_DEG and upper_sides < TURNED_OVER)
