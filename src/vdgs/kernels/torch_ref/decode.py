"""Anchors to splats (Scaffold-GS, section 3.2), in plain torch: the oracle of the native kernel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.kernel_types import AnchorSplats, DecoderWeights, ProjectedGaussians, TrainingSplats
from vdgs.kernels.torch_ref.project import project_with_variances
from vdgs.kernels.transfer import to_like


def decode(
    positions: Float[Tensor, "n 3"],
    features: Float[Tensor, "n 32"],
    offsets: Float[Tensor, "n k 3"],
    log_scales: Float[Tensor, "n 6"],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"] | None = None,
) -> AnchorSplats:
    """Decode visible anchors (`rows` of those given; None: all) for one camera and project what they spawn.

    With d = (x - c)/|x - c| (orthographic: the viewing direction), each head sees [f, d], or
    [f, d, |x - c|] where its first layer is 36 wide: opacity = tanh(·), covariance, color =
    sigmoid(·). μ = x + O·exp(s[0:3]), scales exp(s[3:6])·sigmoid(cov[0:3]), rotation cov[3:7].

    Kept are splats that are opaque (> 0), valid in `project`, finite, and whose alpha reaches 1/255
    within a box that touches the image: what is dropped could not change a pixel. Differentiable in
    everything but the positions. Works in the precision of its arguments.
    """
    k = offsets.shape[1]
    if rows is not None:
        positions, features, offsets, log_scales = (t[rows] for t in (positions, features, offsets, log_scales))
    anchors = _Anchors.of((positions, features, offsets, log_scales), weights, camera)
    usable = (anchors.opacities > 0) & anchors.finite[:, None] & torch.isfinite(offsets).all(-1)
    anchor, offset = usable.nonzero(as_tuple=True)
    projected, variances, drawn = _decode_offsets(anchors, anchor, offset, weights, camera)
    kept = (projected.valid & _on_image(projected.means_px, variances, drawn.opacities, camera)).nonzero()[:, 0]
    return AnchorSplats(
        **{name: getattr(drawn, name)[kept] for name in ("means_px", "conics", "depths", "colors", "opacities")},
        volumes=drawn.volumes[kept],
        source=(anchor * k + offset)[kept].to(torch.int32),
    )


@torch.no_grad()
def decode_for_training(
    positions: Float[Tensor, "n 3"],
    features: Float[Tensor, "n 32"],
    offsets: Float[Tensor, "n k 3"],
    log_scales: Float[Tensor, "n 6"],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"] | None = None,
) -> TrainingSplats:
    """`decode` without autograd, and only what a training step needs. Splats of an anchor are consecutive, in the order
    of its offsets; `TrainingSplats.segments` gives the order of anchors."""
    return TrainingSplats.of(decode(positions, features, offsets, log_scales, weights, camera, rows))


def decode_subset(
    positions: Float[Tensor, "v 3"],
    features: Float[Tensor, "v 32"],
    offsets: Float[Tensor, "v k 3"],
    log_scales: Float[Tensor, "v 6"],
    weights: DecoderWeights,
    camera: Camera,
    source: Int32[Tensor, "m"],
) -> AnchorSplats:
    """`decode` for a known subset of splats, without waiting for a GPU."""
    k = offsets.shape[1]
    anchors = _Anchors.of((positions, features, offsets, log_scales), weights, camera)
    chosen = source.long()
    _, _, drawn = _decode_offsets(anchors, chosen // k, chosen % k, weights, camera)
    return replace(drawn, source=source)


@dataclass(frozen=True, kw_only=True)
class _Anchors:
    """Anchors as a camera sees them, with zeros for what is not finite (0 · NaN would enter gradients of weights)."""

    positions: Float[Tensor, "v 3"]
    offsets: Float[Tensor, "v k 3"]
    log_scales: Float[Tensor, "v 6"]
    inputs: Float[Tensor, "v 36"]
    opacities: Float[Tensor, "v k"]
    finite: Bool[Tensor, "v"]

    @staticmethod
    def of(anchors: tuple[Tensor, Tensor, Tensor, Tensor], weights: DecoderWeights, camera: Camera) -> _Anchors:
        positions, features, offsets, log_scales = anchors
        positions = positions.detach()
        viewing = _viewing(positions, camera)
        finite = _finite_rows(positions, viewing, features, log_scales.exp())
        positions, viewing, features, log_scales = (
            torch.where(finite[:, None], t, torch.zeros_like(t)) for t in (positions, viewing, features, log_scales)
        )
        inputs = torch.cat([features, viewing], -1)
        opacities = torch.tanh(weights.opacity.forward(inputs))
        named = {"positions": positions, "offsets": offsets, "log_scales": log_scales, "inputs": inputs}
        return _Anchors(**named, opacities=opacities, finite=finite)


def _decode_offsets(
    anchors: _Anchors, anchor: Int64[Tensor, "m"], offset: Int64[Tensor, "m"], weights: DecoderWeights, camera: Camera
) -> tuple[ProjectedGaussians, Float[Tensor, "m 2"], AnchorSplats]:
    """What these offsets of these anchors become: projected, their variances along x and y, and all of it as splats."""
    k = anchors.offsets.shape[1]
    covariance = weights.covariance.forward(anchors.inputs).unflatten(1, (k, 7))[anchor, offset]
    color = torch.sigmoid(weights.color.forward(anchors.inputs).unflatten(1, (k, 3))[anchor, offset])
    extent = torch.exp(anchors.log_scales)[anchor]
    means = anchors.positions[anchor] + anchors.offsets[anchor, offset] * extent[:, :3]
    scales = extent[:, 3:] * torch.sigmoid(covariance[:, :3])
    projected, variances = project_with_variances(means, scales, covariance[:, 3:], camera)
    splats = AnchorSplats(
        means_px=projected.means_px, conics=projected.conics, depths=projected.depths, colors=color,
        opacities=anchors.opacities[anchor, offset], volumes=scales.prod(-1),
        source=(anchor * k + offset).to(torch.int32),
    )  # fmt: skip
    return projected, variances, splats


def _viewing(positions: Tensor, camera: Camera) -> Float[Tensor, "v 4"]:
    """Viewing direction and distance of every anchor."""
    ray = positions - to_like(camera.position, positions)
    distance = ray.norm(dim=-1, keepdim=True)
    level = camera.model == "orthographic"
    direction = to_like(camera.forward, positions).expand_as(ray) if level else ray / distance
    return torch.cat([direction, distance], -1)


@torch.no_grad()
def _finite_rows(*tensors: Float[Tensor, "v _"]) -> Bool[Tensor, "v"]:
    return torch.isfinite(torch.cat(tensors, -1)).all(-1)


@torch.no_grad()
def _on_image(means_px: Tensor, variances: Tensor, opacity: Tensor, camera: Camera) -> Bool[Tensor, "m"]:
    """Whether the box around {alpha >= 1/255} reaches the center of any pixel.

    alpha = opacity·exp(-q/2) is 1/255 on the ellipse q = 2·ln(255·opacity), which reaches
    sqrt(q·Σ'xx) to either side of the mean.
    """
    level = 2 * torch.log(opacity / ALPHA_MIN)
    reach = torch.sqrt(level.clamp(min=0)[:, None] * variances)
    size = to_like([camera.width, camera.height], means_px)
    touches = (means_px + reach >= 0.5) & (means_px - reach <= size - 0.5)
    return touches.all(-1) & (level >= 0)
