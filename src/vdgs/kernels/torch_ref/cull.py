"""Which anchors can be seen from a camera, in plain torch."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels.constants import FRUSTUM_MARGIN
from vdgs.kernels.gaussian_projection import dilations_px2
from vdgs.kernels.transfer import to_like


@torch.no_grad()
def cull(positions: Float[Tensor, "n 3"], log_scales: Float[Tensor, "n 6"], camera: Camera) -> Int64[Tensor, "v"]:
    """Indices, ascending, of the anchors whose Gaussian of scales exp(s[0:3]) may touch the image.

    Kept: z > near at the center, and the square about the projected center that surely holds the 3-sigma ellipse
    touches the image. Its half-width along x is 3·sqrt(σ²·(fx/z)²·(1 + u²) + d) with σ = max(exp(s[0:3])), that of the
    sphere around the Gaussian with its dilation d under the same linearization (u = clamp(x/z)) as in `project`; along
    y likewise.
    Choice: no anchor is dropped whose projected ellipse touches the image; a few are kept whose ellipse does not.
    """
    rigid = to_like(camera.camera_from_world, positions)
    local = positions @ rigid[:3, :3].T + rigid[:3, 3]
    sigma_squared = torch.exp(2 * log_scales[:, :3].amax(-1))
    z = local[:, 2]
    near_enough, dilation = z > NEAR_PLANE, dilations_px2(z, camera)
    for axis, focal, center, size, whole in (
        (0, camera.fx, camera.cx, camera.width, camera.full_size[0]),
        (1, camera.fy, camera.cy, camera.height, camera.full_size[1]),
    ):
        if camera.model == "orthographic":
            pixel = focal * local[:, axis] + center
            stretch = torch.full_like(z, focal**2)
        else:
            slope = local[:, axis] / z
            limit = FRUSTUM_MARGIN * 0.5 * whole / focal
            pixel = focal * slope + center
            stretch = (focal / z) ** 2 * (1 + slope.clamp(-limit, limit) ** 2)
        outside = torch.maximum(-pixel, pixel - size).clamp(min=0)
        near_enough = near_enough & (outside**2 <= 9 * (sigma_squared * stretch + dilation))
    return near_enough.nonzero().squeeze(-1)
