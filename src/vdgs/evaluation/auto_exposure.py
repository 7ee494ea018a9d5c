"""Automatic exposure: how a camera answers to what it sees.

Over bright fields a camera lets in less light, over a wood more, from one photograph to the next, so that the mean of
its neighbours in the flight does not tell the exposure of a photograph. What it shows does, and that a trained scene
knows of any view: it is drawn in neutral colours and metered as cameras do, most at the middle. By how much less a
camera exposes what is brighter is learnt from training photographs, each against its neighbours: with x the logarithm
of how much brighter the scene is than between the neighbours, and y that of how much brighter the photograph is
exposed, y = slope x. A camera that is set by hand has slope 0, one that makes all pictures alike has -1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

#: Pictures are metered at this longest side: it is a mean that is wanted.
METERING_SIZE_PX = 96
#: Width of the bell that weighs pixels about the middle, in sides of the picture (choice).
CENTER_SIGMA = 0.2
#: Luminance of red, green and blue (ITU-R BT.601), and what is added to it: nothing is quite black.
LUMINANCE_WEIGHTS, MIN_LUMINANCE = np.array([0.299, 0.587, 0.114]), 1e-3
#: Fewer photographs than this teach nothing.
MIN_SAMPLES = 8
#: The law is used where it foretells photographs that it was not learnt from with at most so much of the error that
#: their neighbours alone leave.
MAX_ERROR_RATIO = 0.95


@dataclass(frozen=True)
class AutoExposure:
    """How cameras of a capture answer to brightness; slope 0: they do not."""

    #: Between -1 and 0.
    slope: float
    #: Brightness beyond what was learnt from counts as this much, either way.
    max_brightness: float
    #: By how much, as logarithms and in the root of the mean square, photographs are brighter than foretold by their
    #: neighbours alone, and by what is metered as well, each by a law that was learnt without it. NaN without any law.
    residual_error: tuple[float, float] = (math.nan, math.nan)

    def gain(self, brighter: float) -> float:
        """The factor on the exposure of a photograph whose view is brighter than between its neighbours, by the
        logarithm."""
        return float(np.exp(self.slope * np.clip(brighter, -self.max_brightness, self.max_brightness)))


def log_luminance(image: Float[np.ndarray, "h w 3"]) -> float:
    """The logarithm of a picture's luminance, most of it from the middle."""
    rows, columns = (np.exp(-0.5 * (((np.arange(n) + 0.5) / n - 0.5) / CENTER_SIGMA) ** 2) for n in image.shape[:2])
    weights = rows[:, None] * columns
    # Products and sums of numpy alone: the bits do not depend on the number of threads.
    light = (image.astype(np.float64) * LUMINANCE_WEIGHTS).sum(-1)
    return float(np.log((light * weights).sum() / weights.sum() + MIN_LUMINANCE))


def fit_auto_exposure(brighter: Float[np.ndarray, " n"], gains: Float[np.ndarray, " n"]) -> AutoExposure:
    """The law that n photographs tell, each by how much brighter its view is and how much brighter it was exposed than
    its neighbours; slope 0 where that foretells hardly better those that are left out, one after the other."""
    products, squares = brighter * gains, brighter**2
    if len(gains) < MIN_SAMPLES or squares.sum() <= squares.max() * (1 + 1e-9):
        return AutoExposure(0.0, 0.0)
    without = np.clip((products.sum() - products) / (squares.sum() - squares), -1.0, 0.0)
    alone, metered_too = (float(np.sqrt(np.square(error).mean())) for error in (gains, gains - without * brighter))
    if metered_too > MAX_ERROR_RATIO * alone:
        return AutoExposure(0.0, 0.0, (alone, metered_too))
    slope = np.clip(products.sum() / squares.sum(), -1.0, 0.0)
    return AutoExposure(float(slope), float(np.abs(brighter).max()), (alone, metered_too))
