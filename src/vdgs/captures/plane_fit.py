"""Similarities in the plane, robustly, and whether a mirror image fits far better: places as complex numbers."""

from __future__ import annotations

import math

import numpy as np

from vdgs.geometry.similarity import rotation_to_z

#: From so many positions on, those that do not fit the others are found and left out.
ENOUGH_TO_DOUBT = 6
#: Smaller deviations than this (metres) are rounding.
LEAST_M = 0.01
#: Pairs that a first fit is drawn from, and places that it is compared with.
MOST_PAIRS, MOST_PLACES = 1000, 500
#: A mirror image explains positions better if the log likelihood is so much larger and the residuals so much smaller.
MIRRORED_BY, MIRRORED_TIMES = 10.0, 0.7
#: Cameras that spread across a line by less than so many residuals do not tell (choice).
ACROSS_TIMES = 1.5


def mirrored(centers: np.ndarray, targets: np.ndarray, up: np.ndarray, others: dict[str, np.ndarray]) -> str:
    """Which of other readings of positions `targets` [n, 3], by what they are called, explains camera centers [n, 3],
    whose up [3] is known for sure, far better than the positions as they are; empty where none does, or where cameras
    along one line, which is its own mirror image, cannot tell."""
    if len(centers) < 3:
        return ""
    source, best, name = in_plane(centers @ rotation_to_z(up).T), 1.0, ""
    plain, _ = _spread_left(source, in_plane(targets))
    for each, changed in others.items():
        left, is_line = _spread_left(source, in_plane(changed))
        if left / plain < best and not is_line:
            best, name = left / plain, each
    more = 2 * len(source) * math.log(1 / max(best, 1e-9))
    return name if best < MIRRORED_TIMES and more > MIRRORED_BY else ""


def in_plane(places: np.ndarray) -> np.ndarray:
    return places[:, 0] + 1j * places[:, 1]


def _spread_left(source: np.ndarray, target: np.ndarray) -> tuple[float, bool]:
    """What the best similarity in the plane leaves, as a share of how far the positions spread; and whether places
    spread across a line by no more than that."""
    factor, shift = fit_plane(source, target)
    off = np.abs(factor * source + shift - target)
    middle = target - np.median(target.real) - 1j * np.median(target.imag)
    left = max(_typical(off), LEAST_M)
    around = factor * (source - source.mean())
    across = np.linalg.svd(np.stack([around.real, around.imag]), compute_uv=False)[1] / math.sqrt(len(source))
    return left / max(_typical(np.abs(middle)), LEAST_M), bool(across <= ACROSS_TIMES * left)


def _typical(off: np.ndarray) -> float:
    return float(np.median(off)) if len(off) >= ENOUGH_TO_DOUBT else float(np.sqrt((off**2).mean()))


def fit_plane(source: np.ndarray, target: np.ndarray) -> tuple[complex, complex]:
    """Factor and shift of complex places [n], robustly: least median over pairs, then least squares of those near."""
    best = _least_squares(source, target, np.ones(len(source), bool))
    if len(source) >= ENOUGH_TO_DOUBT:
        if len(source) * (len(source) - 1) // 2 <= MOST_PAIRS:
            one, other = np.triu_indices(len(source), 1)
        else:
            one, other = np.random.default_rng(0).integers(0, len(source), (2, MOST_PAIRS))
        far = np.abs(source[other] - source[one]) > 0.1 * np.abs(source - source.mean()).max()
        one, other = one[far], other[far]
        factors = np.append((target[other] - target[one]) / (source[other] - source[one]), best[0])
        thin = slice(None, None, 1 + len(source) // MOST_PLACES)
        shifted = target[thin] - factors[:, None] * source[thin]
        shifts = np.median(shifted.real, axis=1) + 1j * np.median(shifted.imag, axis=1)
        k = int(np.median(np.abs(shifted - shifts[:, None]), axis=1).argmin())
        best = complex(factors[k]), complex(shifts[k])
    for _ in range(5):
        off = np.abs(best[0] * source + best[1] - target)
        kept = off <= max(3.0 * _typical(off), LEAST_M)
        best = _least_squares(source, target, kept if kept.sum() >= 2 else np.ones(len(source), bool))
    return best


def _least_squares(source: np.ndarray, target: np.ndarray, kept: np.ndarray) -> tuple[complex, complex]:
    one, other = source[kept].mean(), target[kept].mean()
    away = source[kept] - one
    factor = complex((np.conj(away) * (target[kept] - other)).sum() / max(float((np.abs(away) ** 2).sum()), 1e-300))
    return factor, complex(other - factor * one)
