"""Perspective (EWA) projection of 3D Gaussians onto the image in plain torch, differentiable in the pose too.

3DGS, eq. 5: Σ' = J W Σ Wᵀ Jᵀ with Σ = R S Sᵀ Rᵀ (eq. 6), where W is the rotation of the camera and J
the Jacobian of the projection at the mean. Σ' gets 0.3 px² on its diagonal, and where the camera names the pixel of a
photograph at least 0.3 of such pixels (`dilations_px2`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.constants import DILATION_PX2, FRUSTUM_MARGIN
from vdgs.kernels.kernel_types import ProjectedGaussians
from vdgs.kernels.rotations import rotation_matrices
from vdgs.kernels.transfer import to_like

#: Below this share of its area a Gaussian has no derivative by what the dilation takes of it: that of a root at 0.
MIN_AREA_SHARE = 1e-12


class GaussianShapes(NamedTuple):
    """Shapes of m Gaussians: standard deviations along their axes and wxyz rotations, or covariances in the world."""

    scales: Float[Tensor, "m 3"] | None
    quaternions: Float[Tensor, "m 4"] | None
    covariances: Float[Tensor, "m 3 3"] | None = None

    def masked(self, valid: Bool[Tensor, " m"]) -> GaussianShapes:
        """The same with a unit ball where not valid: 0 · NaN never enters a gradient."""
        shown = valid[:, None]
        if self.covariances is not None:
            ball = torch.eye(3, dtype=self.covariances.dtype, device=self.covariances.device)
            return GaussianShapes(None, None, torch.where(shown[..., None], self.covariances, ball))
        assert self.scales is not None
        assert self.quaternions is not None
        return GaussianShapes(
            torch.where(shown, self.scales, torch.ones_like(self.scales)),
            torch.where(shown, self.quaternions, to_like([1.0, 0.0, 0.0, 0.0], self.quaternions)),
        )

    def moments(self, along_x: Float[Tensor, "m 3"], along_y: Float[Tensor, "m 3"]) -> tuple[Tensor, ...]:
        """xx, xy and yy of Σ' without dilation, and its determinant, for the two rows of J W.

        From axes the determinant is |x × y|² of the projected axes: no difference of large numbers, so that needles
        keep their precision.
        """
        if self.covariances is not None:
            of_x = torch.einsum("mi,mij->mj", along_x, self.covariances)
            of_y = torch.einsum("mi,mij->mj", along_y, self.covariances)
            xx, xy, yy = (of_x * along_x).sum(-1), (of_x * along_y).sum(-1), (of_y * along_y).sum(-1)
            return xx, xy, yy, (xx * yy - xy * xy).clamp(min=0)
        assert self.scales is not None
        assert self.quaternions is not None
        axes = rotation_matrices(self.quaternions) * self.scales[:, None, :]
        row_x, row_y = torch.einsum("mi,mij->mj", along_x, axes), torch.einsum("mi,mij->mj", along_y, axes)
        cross = torch.linalg.cross(row_x, row_y)
        return (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1), (cross * cross).sum(-1)


class GaussianProjection(NamedTuple):
    """Projected Gaussians, and what else their covariances say."""

    projected: ProjectedGaussians
    #: Dilated variances along x and y in px² (one where not valid).
    variances: Float[Tensor, "m 2"]
    #: Root of the share of its area that a Gaussian has without dilation (Mip-Splatting, eq. 9).
    compensation: Float[Tensor, " m"]


def project_gaussians(
    means: Float[Tensor, "m 3"],
    shapes: GaussianShapes,
    camera: Camera,
    pose: Float[Tensor, "4 4"] | None = None,
    *,
    dilation_px2: float = DILATION_PX2,
    depths: tuple[float, float] = (NEAR_PLANE, math.inf),
) -> GaussianProjection:
    """Project Gaussians, valid between two depths. `pose` is that of the camera (`camera_from_world`) as a tensor.

    Differentiable in means, shapes and pose, in the precision of the means. See `torch_ref.project` for what is valid
    and for the bounds of J.
    """
    rigid = to_like(camera.camera_from_world, means) if pose is None else pose
    rotation, translation = rigid[:3, :3], rigid[:3, 3]
    local = means @ rotation.T + translation
    with torch.no_grad():
        valid = _is_valid(local, shapes, rotation, camera, dilations_px2(local[:, 2], camera, dilation_px2), depths)
    # What is not valid is replaced before the arithmetic.
    shown = valid[:, None]
    local = torch.where(shown, local, to_like([0.0, 0.0, 1.0], local))
    dilation = dilations_px2(local[:, 2], camera, dilation_px2)
    conics, variances, share = _conics(local, shapes.masked(valid), rotation, camera, dilation)
    projected = ProjectedGaussians(
        means_px=torch.where(shown, _pixels(local, camera), 0.0),
        conics=torch.where(shown, conics, 0.0),
        depths=torch.where(valid, local[:, 2], 0.0),
        valid=valid,
    )
    return GaussianProjection(
        projected, torch.where(shown, variances, 1.0), share.clamp(min=MIN_AREA_SHARE).sqrt() * valid
    )


def variances_px2(conics: Float[Tensor, "m 3"]) -> Float[Tensor, "m 2"]:
    """Variances along x and y: the conic [[a, b], [b, c]] is the inverse of the covariance."""
    a, b, c = conics.unbind(-1)
    return torch.stack([c, a], -1) / (a * c - b * b)[:, None]


def dilations_px2(
    depths: Float[Tensor, " m"], camera: Camera, least: float = DILATION_PX2
) -> Float[Tensor, " m"] | float:
    """What is added to the variances of Gaussians at these depths, in px² (choice): `least`, or as much as in a view in
    which a pixel is as large as one of a photograph (`Camera.photograph_pixel`)."""
    if not camera.photograph_pixel:
        return least
    blur = least * camera.photograph_pixel**2 * camera.fx * camera.fy
    return (blur / (depths**2 if camera.model == "pinhole" else torch.ones_like(depths))).clamp(min=least)


def area_shares(conics: Float[Tensor, "m 3"], blur_px2: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Share of its area that a projected Gaussian has without a blur, a part b of the dilation, from its conic K alone:
    the root of det(Σ' - b) / det Σ' = det(1 - b K). 1 without any blur; elsewhere right to 3e-4 (float32)."""
    a, b, c = (conics * blur_px2[:, None]).unbind(-1)
    return ((1 - a) * (1 - c) - b * b).clamp(0, 1).sqrt()


def _pixels(local: Tensor, camera: Camera) -> Tensor:
    x, y, z = local.unbind(-1)
    divisor = z if camera.model == "pinhole" else torch.ones_like(z)
    return torch.stack([camera.fx * x / divisor + camera.cx, camera.fy * y / divisor + camera.cy], -1)


def _rows_of_jacobian(local: Tensor, rotation: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The two rows of J W, each [m, 3]."""
    if camera.model == "orthographic":
        return (camera.fx * rotation[0]).expand_as(local), (camera.fy * rotation[1]).expand_as(local)
    z = local[:, 2:3]
    limit_x = FRUSTUM_MARGIN * 0.5 * camera.full_size[0] / camera.fx
    limit_y = FRUSTUM_MARGIN * 0.5 * camera.full_size[1] / camera.fy
    u = (local[:, 0:1] / z).clamp(-limit_x, limit_x)
    v = (local[:, 1:2] / z).clamp(-limit_y, limit_y)
    return camera.fx / z * (rotation[0] - u * rotation[2]), camera.fy / z * (rotation[1] - v * rotation[2])


def _conics(
    local: Tensor, shapes: GaussianShapes, rotation: Tensor, camera: Camera, dilation: Tensor | float
) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse of [[xx + d, xy], [xy, yy + d]] for the dilation d, its diagonal, and the share of the determinant that
    it has without d. The determinant is that without d, + d(xx + yy) + d²."""
    xx, xy, yy, area = shapes.moments(*_rows_of_jacobian(local, rotation, camera))
    determinant = area + dilation * (xx + yy) + dilation**2
    variances = torch.stack([xx + dilation, yy + dilation], -1)
    return (
        torch.stack([variances[:, 1], -xy, variances[:, 0]], -1) / determinant[:, None],
        variances,
        area / determinant,
    )


def _is_valid(
    local: Tensor,
    shapes: GaussianShapes,
    rotation: Tensor,
    camera: Camera,
    dilation: Tensor | float,
    depths: tuple[float, float],
) -> Bool[Tensor, "m"]:
    conics, _, _ = _conics(local, shapes, rotation, camera, dilation)
    numbers = torch.cat([local, _pixels(local, camera), conics], -1)
    # An overflowing covariance divides finite by infinite: the conic vanishes instead of failing.
    proper = torch.isfinite(numbers).all(-1) & (conics[:, 0] > 0) & (conics[:, 2] > 0)
    return proper & (local[:, 2] > depths[0]) & (local[:, 2] < depths[1])
