"""The Gaussians of anchors in the world, as seen by one camera (Scaffold-GS eqs. 3-8, as in
`kernels.torch_ref.decode`).

Dimensions: v anchors, k offsets of each.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import DecoderWeights
from vdgs.model.anchors import Anchors


@dataclass(frozen=True, eq=False)
class DecodedGaussians:
    """The k Gaussians of each anchor: all but their places depend on where they are seen from."""

    #: tanh of the opacity head: not drawn where it is 0 or less.
    opacities: Float[Tensor, "v k"]
    colors: Float[Tensor, "v k 3"]
    scales: Float[Tensor, "v k 3"]
    #: wxyz, of any length.
    quaternions: Float[Tensor, "v k 4"]


def gaussian_means(anchors: Anchors) -> Float[Tensor, "v k 3"]:
    """Where the Gaussians are, from wherever they are seen."""
    return anchors.positions[:, None] + anchors.offsets * anchors.log_scales[:, None, :3].exp()


def decode_world(
    anchors: Anchors, rows: Int64[Tensor, " v"], weights: DecoderWeights, camera: Camera
) -> DecodedGaussians:
    """The Gaussians of the anchors of the given rows, differentiable in the decoder's weights and the anchors."""
    k = anchors.offsets.shape[1]
    ray = anchors.positions[rows] - torch.as_tensor(camera.position, device="cpu").to(anchors.positions)
    distance = ray.norm(dim=1, keepdim=True)
    level = camera.model == "orthographic"
    direction = torch.as_tensor(camera.forward, device="cpu").to(ray).expand_as(ray) if level else ray / distance
    inputs = torch.cat([anchors.features[rows], direction, distance], 1)
    covariance = weights.covariance.forward(inputs).unflatten(1, (k, 7))
    opacities = weights.opacity.forward(inputs).tanh()
    if anchors.opacity_factors is not None:
        opacities = opacities * anchors.opacity_factors[rows]
    return DecodedGaussians(
        opacities,
        weights.color.forward(inputs).unflatten(1, (k, 3)).sigmoid(),
        anchors.log_scales[rows, None, 3:].exp() * covariance[..., :3].sigmoid(),
        covariance[..., 3:],
    )
