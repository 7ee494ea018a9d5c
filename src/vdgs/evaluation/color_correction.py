"""Color correction before a comparison: a render is not blamed for the exposure of its photograph.

Two of them. The correction of multinerf (Barron et al. 2022), which DOGS applies always and Momentum-GS on request:
five rounds of least squares from ten quadratic color features of the render to the photograph. And one affine map of
the colors, the least that another exposure and white balance need: what a model of exposure in training can undo.
Both are fitted on the test image itself, so a corrected figure never stands without the raw one beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

FIT_ITERATIONS = 5
#: A value counts as saturated within half a level of 8 bits of black or white.
SATURATION_MARGIN = 0.5 / 255
#: Fewer usable pixels than this (ten for each coefficient) and nothing is fitted (choice).
MIN_PIXELS = 100
#: Pixels whose features are held at a time. Bounds the memory on large photographs, keeps the features
#: in cache, and the products below the size at which OpenBLAS wakes threads (three times slower on two
#: busy cores).
PIXELS_PER_CHUNK = 2048


@dataclass(frozen=True, eq=False)
class ColorCorrection:
    """The corrected image, float64 [h, w, 3] in [0, 1], and whether there was enough to fit it."""

    image: Float[np.ndarray, "h w 3"]
    fitted: bool


def correct_colors(
    image: np.ndarray,
    reference: np.ndarray,
    mask: Bool[np.ndarray, "h w"] | None = None,
    iterations: int = FIT_ITERATIONS,
    chunk: int = PIXELS_PER_CHUNK,
) -> ColorCorrection:
    """Warp the colors of `image` [h, w, 3] towards those of `reference`, both uint8 or floats in [0, 1].

    Each round regresses every channel of the reference on the features of the current estimate, over
    the pixels whose value in that channel is unsaturated in the input, in the current estimate and in
    the reference, because the set of saturated pixels moves with the colors. `mask` restricts the fit,
    not the image that comes back. The features of `chunk` pixels are held at a time. With fewer than
    `MIN_PIXELS` usable pixels in any channel of any round the image comes back unchanged, `fitted` false.
    """
    return _correct(image, reference, mask, iterations, _quadratic, chunk)


def correct_colors_affine(
    image: np.ndarray, reference: np.ndarray, mask: Bool[np.ndarray, "h w"] | None = None
) -> ColorCorrection:
    """As `correct_colors`, but by one affine map of the colors, fitted once."""
    return _correct(image, reference, mask, 1, _affine)


FeatureFunction = Callable[[Float[np.ndarray, "3 n"]], np.ndarray]


def _correct(
    image: np.ndarray,
    reference: np.ndarray,
    mask: Bool[np.ndarray, "h w"] | None,
    iterations: int,
    features: FeatureFunction,
    chunk: int = PIXELS_PER_CHUNK,
) -> ColorCorrection:
    start, target = _planes(image), _planes(reference)
    kept = True if mask is None else mask.reshape(1, -1)
    usable = kept & _unsaturated(start) & _unsaturated(target)
    current, fitted = start, True
    for _ in range(iterations):
        coefficients = _fit(current, target, usable & _unsaturated(current), features, chunk)
        if coefficients is None:
            current, fitted = start, False
            break
        warped = [np.clip(coefficients @ features(current[:, at]), 0.0, 1.0) for at in _chunks(current, chunk)]
        current = np.concatenate(warped, axis=1)
    return ColorCorrection(np.ascontiguousarray(current.T).reshape(image.shape), fitted)


def _fit(
    current: Float[np.ndarray, "3 n"],
    target: Float[np.ndarray, "3 n"],
    usable: Bool[np.ndarray, "3 n"],
    features_of: FeatureFunction,
    chunk: int,
) -> Float[np.ndarray, "3 f"] | None:
    """Least squares per channel from its own usable pixels, through the normal equations."""
    if usable.sum(axis=1).min() < MIN_PIXELS:
        return None
    count = len(features_of(current[:, :1]))
    gram, moment = np.zeros((3, count, count)), np.zeros((3, count))
    for at in _chunks(current, chunk):
        features = features_of(current[:, at])
        for channel in range(3):
            counted = features * usable[channel, at]
            gram[channel] += counted @ features.T
            moment[channel] += counted @ target[channel, at]
    # lstsq, not solve: a gray image makes the features collinear, and then the smallest solution is meant.
    return np.stack([np.linalg.lstsq(gram[c], moment[c], rcond=1e-13)[0] for c in range(3)])


def _affine(rgb: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "4 n"]:
    """r, g, b, 1."""
    return np.concatenate([rgb, np.ones_like(rgb[:1])])


def _quadratic(rgb: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "10 n"]:
    """r², rg, rb, g², gb, b², r, g, b, 1."""
    r, g, b = rgb
    return np.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, np.ones_like(r)])


def _unsaturated(rgb: np.ndarray) -> np.ndarray:
    return (rgb >= SATURATION_MARGIN) & (rgb <= 1.0 - SATURATION_MARGIN)


def _planes(image: np.ndarray) -> Float[np.ndarray, "3 n"]:
    planes = np.ascontiguousarray(image.reshape(-1, 3).T, dtype=np.float64)
    return planes / 255.0 if image.dtype == np.uint8 else planes


def _chunks(planes: Float[np.ndarray, "3 n"], chunk: int) -> list[slice]:
    return [slice(start, start + chunk) for start in range(0, planes.shape[1], chunk)]
