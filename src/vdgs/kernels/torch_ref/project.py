"""Perspective (EWA) projection of 3D Gaussians onto the image, in plain torch (`kernels.gaussian_projection`)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.gaussian_projection import GaussianShapes, project_gaussians
from vdgs.kernels.kernel_types import ProjectedGaussians


def project(
    means: Float[Tensor, "m 3"], scales: Float[Tensor, "m 3"], quaternions: Float[Tensor, "m 4"], camera: Camera
) -> ProjectedGaussians:
    """Project Gaussians (world means, standard deviations along their axes, wxyz rotations).

    Quaternions are normalized here. Works in the precision of its arguments and is differentiable in all three. Not
    valid, thus all zero and without gradient: z <= near, and whatever does not come out as finite numbers.

    In J, x/z and y/z are clamped to 1.3 times the half-angle of the frustum on either side, as 3DGS does: the
    linearization explodes far outside the image. The derivative is that of the clamped function: J's u = clamp(x/z)
    stands still beyond the bound, whether x or z moves.
    """
    return project_with_variances(means, scales, quaternions, camera)[0]


def project_with_variances(
    means: Float[Tensor, "m 3"], scales: Float[Tensor, "m 3"], quaternions: Float[Tensor, "m 4"], camera: Camera
) -> tuple[ProjectedGaussians, Float[Tensor, "m 2"]]:
    """`project`, and the dilated variances along x and y in px² (one where not valid)."""
    return project_gaussians(means, GaussianShapes(scales, quaternions), camera)[:2]
