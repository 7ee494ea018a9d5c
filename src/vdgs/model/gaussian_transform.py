"""Gaussians moved, turned and scaled, with the colors that their spherical harmonics show.

The law: a transformed scene drawn from a transformed camera is the same picture. Rotations are those of space, in
float64; coefficients of color turn with them by a matrix per band (Wigner's D for real functions).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.kernels.rotations import rotation_matrices
from vdgs.kernels.spherical_harmonics import MAX_SH_DEGREE, eval_sh_bases
from vdgs.model.gaussians import Gaussians

#: How far a rotation matrix may be from one, in each of its numbers.
TOLERANCE = 1e-6


def transform_gaussians(
    gaussians: Gaussians, scale: float, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
) -> Gaussians:
    """The Gaussians under x -> scale * rotation @ x + translation.

    Means are computed in float64. Raises ValueError for what is no rotation or no positive scale.
    """
    if not scale > 0 or not math.isfinite(scale):
        raise ValueError(f"a similarity needs a positive scale, not {scale}")
    _check(rotation)
    turned = gaussians.means.double() @ torch.from_numpy(np.ascontiguousarray(rotation.T, np.float64))
    means = scale * turned + torch.from_numpy(np.asarray(translation, np.float64))
    return Gaussians(
        means=means.float(),
        log_scales=gaussians.log_scales + math.log(scale),
        quaternions=multiply_quaternions(quaternion_from_matrix(rotation), gaussians.quaternions),
        opacity_logits=gaussians.opacity_logits,
        sh0=gaussians.sh0,
        shN=rotate_sh(gaussians.shN, rotation),
    )


def rotate_sh(rest: Float[Tensor, "n r 3"], rotation: Float[np.ndarray, "3 3"]) -> Float[Tensor, "n r 3"]:
    """Coefficients of the functions that show along R d what `rest` shows along d, for whole bands 1 .. degree <= 3.

    Raises ValueError for what is no rotation, and where `rest` holds a band only in part.
    """
    _check(rotation)
    degree = math.isqrt(rest.shape[1] + 1) - 1
    if (degree + 1) ** 2 != rest.shape[1] + 1 or degree > MAX_SH_DEGREE:
        raise ValueError(f"{rest.shape[1]} further coefficients of color belong to no degree up to {MAX_SH_DEGREE}")
    parts, start = [], 0
    for band in range(1, degree + 1):
        width = 2 * band + 1
        matrix = sh_band_rotation(band, rotation).to(rest)
        parts.append(torch.einsum("ij,njc->nic", matrix, rest[:, start : start + width]))
        start += width
    return torch.cat(parts, 1) if parts else rest


def sh_band_rotation(band: int, rotation: Float[np.ndarray, "3 3"]) -> Float[Tensor, "f f"]:
    """The matrix by which a rotation turns the coefficients of one band, f = 2 band + 1; float64, orthogonal.

    f'(d) = f(R^T d) is a function of the same band, so its values in more directions than the band has functions fix
    its coefficients: whatever the order, signs and norm of the functions, which are those of `eval_sh_bases`.
    """
    directions = _directions()
    turned = directions @ torch.from_numpy(np.ascontiguousarray(rotation, np.float64))  # rows R^T d
    part = slice(band**2, (band + 1) ** 2)
    return torch.linalg.lstsq(eval_sh_bases(directions, band)[:, part], eval_sh_bases(turned, band)[:, part]).solution


def quaternion_from_matrix(rotation: Float[np.ndarray, "3 3"]) -> Float[Tensor, "4"]:
    """The unit quaternion, wxyz, of a rotation matrix; float64."""
    m = np.asarray(rotation, np.float64)
    # The eigenvector of the largest eigenvalue: exact for every angle, half turns too (Bar-Itzhack, 2000).
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    vector = np.linalg.eigh(k)[1][:, -1]
    return torch.from_numpy(vector if vector[0] >= 0 else -vector)


def multiply_quaternions(left: Float[Tensor, "4"], right: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """Quaternions (wxyz) of the rotations `right`, each followed by `left`; of the type of `right`."""
    w, x, y, z = left.tolist()
    matrix = torch.tensor(
        [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64, device="cpu"
    )
    # In float64: the last bits of a float32 product depend, on some machines, on how many rows there are.
    return (right.double() @ matrix.T).to(right)


def gaussian_covariances(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """R S S R^T of every Gaussian."""
    spread = rotation_matrices(gaussians.quaternions) * gaussians.log_scales.exp()[:, None, :]
    return spread @ spread.transpose(1, 2)


@lru_cache(maxsize=1)
def _directions() -> Tensor:
    """Unit directions spread evenly over the sphere (a Fibonacci lattice), several times the functions of a band."""
    count = 64
    index = np.arange(count) + 0.5
    z, angle = 1 - 2 * index / count, np.pi * (1 + math.sqrt(5)) * index
    ring = np.sqrt(1 - z**2)
    return torch.from_numpy(np.stack([ring * np.cos(angle), ring * np.sin(angle), z], -1))


def _check(rotation: np.ndarray) -> None:
    matrix = np.asarray(rotation, np.float64)
    if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < TOLERANCE and np.linalg.det(matrix) > 0):
        raise ValueError(f"this is no rotation: {matrix.tolist()}")
