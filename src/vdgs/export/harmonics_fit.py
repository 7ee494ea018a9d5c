"""Spherical harmonics fitted to the colours that cameras saw: weighted ridge regressions, many at once, in closed form.

Of each Gaussian: minimise over c  Σ_v w_v |Y(d_v) c - (colour_v - 1/2)|² / Σ_v w_v + RIDGE |c'|²,
where c' are the coefficients but the constant one. Dimensions: p pairs of a Gaussian and a camera, sorted by Gaussian;
m Gaussians; f = (degree + 1)² functions.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vdgs.model.spherical_harmonics import basis

#: Pull of the coefficients towards one colour for all directions (choice): where cameras look from few directions, the
#: others must not swing. Of 1e-3, 1e-2 and 1e-1 on validation views the middle one (docs/export.md).
RIDGE = 1e-2


def segment_sums(values: Float[np.ndarray, " p"], starts: Int[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    """Sums of runs of consecutive values, by where each begins; none is empty."""
    return np.add.reduceat(values, starts)


def fit_harmonics(
    directions: Float[Tensor, "p 3"],
    colours: Float[Tensor, "p 3"],
    weights: Float[Tensor, " p"],
    starts: Int[np.ndarray, " m"],
    degree: int,
) -> Float[Tensor, "m f 3"]:
    """Coefficients of each Gaussian, whose pairs begin at `starts`. Directions are unit, from the camera."""
    functions = basis(directions, degree).numpy().T
    share = weights.numpy()
    total = segment_sums(share, starts)
    wanted = colours.numpy().T - 0.5
    f, m = len(functions), len(starts)
    matrix, right = np.empty((f, f, m), np.float32), np.empty((f, 3, m), np.float32)
    for i in range(f):
        weighted = share * functions[i]
        for j in range(i + 1):
            matrix[i, j] = segment_sums(weighted * functions[j], starts) / total
        for channel in range(3):
            right[i, channel] = segment_sums(weighted * wanted[channel], starts) / total
        matrix[i, i] += RIDGE if i else 0.0
    return torch.from_numpy(_solved(matrix, right)).permute(2, 0, 1)


def _solved(matrix: Float[np.ndarray, "f f m"], right: Float[np.ndarray, "f 3 m"]) -> Float[np.ndarray, "f 3 m"]:
    """Solve m positive definite systems, given by their lower triangles, by Cholesky's decomposition, all systems at
    once in each operation. Overwrites both."""
    f = len(matrix)
    for j in range(f):
        for k in range(j):
            matrix[j:, j] -= matrix[j:, k] * matrix[j, k]
        matrix[j:, j] /= np.sqrt(np.maximum(matrix[j, j], np.float32(1e-12)))
    for j in range(f):  # L y = b
        right[j] /= matrix[j, j]
        right[j + 1 :] -= matrix[j + 1 :, j, None] * right[j]
    for j in reversed(range(f)):  # Lᵀ x = y
        right[j] /= matrix[j, j]
        right[:j] -= matrix[j, :j, None] * right[j]
    return right
