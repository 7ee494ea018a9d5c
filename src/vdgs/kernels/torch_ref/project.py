"""Perspective (EWA) projection of 3D Gaussians onto the image, in plain torch.

3DGS, eq. 5: Σ' = J W Σ Wᵀ Jᵀ with Σ = R S Sᵀ Rᵀ (eq. 6), where W is the rotation of the camera and J
the Jacobian of the projection at the mean. Σ' gets 0.3 px² on its diagonal.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.constants import DILATION_PX2, FRUSTUM_MARGIN
from vdgs.kernels.kernel_types import ProjectedGaussians
from vdgs.kernels.rotations import rotation_matrices
from vdgs.kernels.transfer import to_like


def project(
    means: Float[Tensor, "m 3"], scales: Float[Tensor, "m 3"], quaternions: Float[Tensor, "m 4"], camera: Camera
) -> ProjectedGaussians:
    """Project Gaussians (world means, standard deviations along their axes, wxyz rotations).

    Quaternions are normalised here. Works in the precision of its arguments and is differentiable in all three. Not
    valid, thus all zero and without gradient: z <= near, and whatever does not come out as finite numbers.

    In J, x/z and y/z are clamped to 1.3 times the half-angle of the frustum on either side, as 3DGS does: the
    linearisation explodes far outside the image. The derivative is that of the clamped function: J's u = clamp(x/z)
    stands still beyond the bound, whether x or z moves.
    """
    return project_with_variances(means, scales, quaternions, camera)[0]


def project_with_variances(
    means: Float[Tensor, "m 3"], scales: Float[Tensor, "m 3"], quaternions: Float[Tensor, "m 4"], camera: Camera
) -> tuple[ProjectedGaussians, Float[Tensor, "m 2"]]:
    """`project`, and the dilated variances along x and y in px² (one where not valid)."""
    rigid = to_like(camera.camera_from_world, means)
    rotation, translation = rigid[:3, :3], rigid[:3, 3]
    local = means @ rotation.T + translation
    with torch.no_grad():
        valid = _is_valid(local, scales, quaternions, rotation, camera)
    # What is not valid is replaced before the arithmetic, so that 0 · NaN never enters a gradient.
    shown = valid[:, None]
    local = torch.where(shown, local, to_like([0.0, 0.0, 1.0], local))
    scales = torch.where(shown, scales, torch.ones_like(scales))
    quaternions = torch.where(shown, quaternions, to_like([1.0, 0.0, 0.0, 0.0], quaternions))

    conics, variances = _conics(*_axes_px(local, scales, quaternions, rotation, camera))
    projected = ProjectedGaussians(
        means_px=torch.where(shown, _pixels(local, camera), 0.0),
        conics=torch.where(shown, conics, 0.0),
        depths=torch.where(valid, local[:, 2], 0.0),
        valid=valid,
    )
    return projected, torch.where(shown, variances, 1.0)


def _pixels(local: Tensor, camera: Camera) -> Tensor:
    x, y, z = local.unbind(-1)
    divisor = z if camera.model == "pinhole" else torch.ones_like(z)
    return torch.stack([camera.fx * x / divisor + camera.cx, camera.fy * y / divisor + camera.cy], -1)


def _axes_px(
    local: Tensor, scales: Tensor, quaternions: Tensor, rotation: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """The two rows of J W R S, each [m, 3]: the Gaussian's three semi-axes seen along x and along y."""
    axes = rotation_matrices(quaternions) * scales[:, None, :]
    if camera.model == "orthographic":
        along_x = (camera.fx * rotation[0]).expand_as(local)
        along_y = (camera.fy * rotation[1]).expand_as(local)
    else:
        z = local[:, 2:3]
        limit_x = FRUSTUM_MARGIN * 0.5 * camera.full_size[0] / camera.fx
        limit_y = FRUSTUM_MARGIN * 0.5 * camera.full_size[1] / camera.fy
        u = (local[:, 0:1] / z).clamp(-limit_x, limit_x)
        v = (local[:, 1:2] / z).clamp(-limit_y, limit_y)
        along_x = camera.fx / z * (rotation[0] - u * rotation[2])
        along_y = camera.fy / z * (rotation[1] - v * rotation[2])
    return torch.einsum("mi,mij->mj", along_x, axes), torch.einsum("mi,mij->mj", along_y, axes)


def _conics(row_x: Tensor, row_y: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse of [[x·x + d, x·y], [x·y, y·y + d]] for rows x, y and dilation d; and its diagonal.

    The determinant is |x × y|² + d(x·x + y·y) + d²: no difference of large numbers, so that needles
    keep their precision.
    """
    xx, xy, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    cross = torch.linalg.cross(row_x, row_y)
    determinant = (cross * cross).sum(-1) + DILATION_PX2 * (xx + yy) + DILATION_PX2**2
    variances = torch.stack([xx, yy], -1) + DILATION_PX2
    return torch.stack([variances[:, 1], -xy, variances[:, 0]], -1) / determinant[:, None], variances


def _is_valid(
    local: Tensor, scales: Tensor, quaternions: Tensor, rotation: Tensor, camera: Camera
) -> Bool[Tensor, "m"]:
    conics, _ = _conics(*_axes_px(local, scales, quaternions, rotation, camera))
    numbers = torch.cat([local, _pixels(local, camera), conics], -1)
    # An overflowing covariance divides finite by infinite: the conic vanishes instead of failing.
    proper = torch.isfinite(numbers).all(-1) & (conics[:, 0] > 0) & (conics[:, 2] > 0)
    return proper & (local[:, 2] > NEAR_PLANE)
