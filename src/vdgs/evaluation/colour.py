"""Colour correction before a comparison: a render is not blamed for the exposure of its photograph.

The correction of multinerf (Barron et al. 2022), which DOGS applies always and Momentum-GS on request:
five rounds of least squares from ten quadratic colour features of the render to the photograph. It is
fitted on the test image itself, so a corrected figure never stands without the raw one beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

ROUNDS = 5
#: A value counts as saturated within half a level of 8 bits of black or white.
SATURATION = 0.5 / 255
#: Fewer usable pixels than this (ten for each coefficient) and nothing is fitted (choice).
MIN_PIXELS = 100
#: Rows of the design matrix held at a time; bounds the memory on large photographs.
CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class ColourCorrection:
    """The corrected image, float64 [h, w, 3] in [0, 1], and whether there was enough to fit it."""

    image: Float[np.ndarray, "h w 3"]
    fitted: bool


def correct_colours(
    image: np.ndarray,
    reference: np.ndarray,
    mask: Bool[np.ndarray, "h w"] | None = None,
    rounds: int = ROUNDS,
) -> ColourCorrection:
    """Warp the colours of `image` [h, w, 3] towards those of `reference`, both uint8 or floats in [0, 1].

    Each round regresses every channel of the reference on the features of the current estimate, over
    the pixels whose value in that channel is unsaturated in the input, in the current estimate and in
    the reference, because the set of saturated pixels moves with the colours. `mask` restricts the fit,
    not the image that comes back. With fewer than `MIN_PIXELS` usable pixels in any channel of any
    round the image comes back unchanged, `fitted` false.
    """
    height, width, _ = image.shape
    start, target = _unit(image), _unit(reference)
    kept = np.ones((height * width, 1), bool) if mask is None else mask.reshape(-1, 1)
    usable = kept & _unsaturated(start) & _unsaturated(target)
    current = start
    for _ in range(rounds):
        coefficients = _fit(current, target, usable & _unsaturated(current))
        if coefficients is None:
            return ColourCorrection(start.reshape(height, width, 3), fitted=False)
        current = np.concatenate(
            [np.clip(_features(rows) @ coefficients, 0.0, 1.0) for rows in _chunks(current)]
        )
    return ColourCorrection(current.reshape(height, width, 3), fitted=True)


def _fit(
    current: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], usable: Bool[np.ndarray, "n 3"]
) -> Float[np.ndarray, "10 3"] | None:
    """Least squares per channel from its own usable rows, through the normal equations."""
    if usable.sum(axis=0).min() < MIN_PIXELS:
        return None
    gram, moment = np.zeros((3, 10, 10)), np.zeros((3, 10))
    for rows, values, chosen in zip(_chunks(current), _chunks(target), _chunks(usable), strict=True):
        features = _features(rows)
        for channel in range(3):
            design = features[chosen[:, channel]]
            gram[channel] += design.T @ design
            moment[channel] += design.T @ values[chosen[:, channel], channel]
    # lstsq, not solve: a grey image makes the features collinear, and then the smallest solution is meant.
    solved = [np.linalg.lstsq(gram[c], moment[c], rcond=1e-13)[0] for c in range(3)]
    return np.stack(solved, axis=1)


def _features(rgb: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 10"]:
    """r², rg, rb, g², gb, b², r, g, b, 1."""
    r, g, b = rgb.T
    return np.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, np.ones_like(r)], axis=1)


def _unsaturated(rgb: np.ndarray) -> np.ndarray:
    return (rgb >= SATURATION) & (rgb <= 1.0 - SATURATION)


def _unit(image: np.ndarray) -> Float[np.ndarray, "n 3"]:
    rows = image.reshape(-1, 3).astype(np.float64)
    return rows / 255.0 if image.dtype == np.uint8 else rows


def _chunks(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK)]
