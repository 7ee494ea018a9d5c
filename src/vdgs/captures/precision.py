"""Coordinates that lost digits before they came here: survey coordinates are large, and float32 has seven digits.

Everything in this package is float64 until it is in the ground frame, whose origin is in the place. What a file holds
in too few digits is lost all the same, and can only be told.
"""

from __future__ import annotations

import numpy as np

#: Rounding by this share of the distance between cameras and points is about a pixel (choice).
VISIBLE_SHARE = 1e-3
#: An axis with fewer distinct values may be made of steps (floors, terraces), not rounded.
LEAST_VALUES = 20
#: How far a rounded value may be off its step, as a share of it.
SLACK = 1e-3


def rounding_of(points: np.ndarray, distance: float) -> float:
    """The step to which some axis of the points [n, 3] is rounded, in their unit; 0 where none can be seen from
    `distance`. Steps are powers of two (float32) and of ten (decimals)."""
    least = VISIBLE_SHARE * distance
    if not least > 0:
        return 0.0
    powers = np.concatenate([2.0 ** np.arange(-20, 21), 10.0 ** np.arange(-6, 7)])
    steps = [step for step in sorted(powers, reverse=True) if least <= step <= distance]
    axes = [axis for axis in points.T if len(np.unique(axis)) >= LEAST_VALUES]
    return max((_step(axis, steps) for axis in axes), default=0.0)


def _step(values: np.ndarray, steps: list[float]) -> float:
    """The largest of the steps, in falling order, of which all values are multiples; 0 for none."""
    for step in steps:
        if (np.abs(values / step - np.round(values / step)) <= SLACK).all():
            return float(step)
    return 0.0
