"""From the gradients of splats to a step of Adam for their anchors: autograd, then Adam parameter by parameter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.kernel_types import AdamState, DecoderWeights, IsFinite, SplatGradients
from vdgs.kernels.splat_segments import sources_tensor
from vdgs.kernels.torch_ref.adam import adam_rows, check_updates
from vdgs.kernels.torch_ref.decode import decode_subset


def decode_backward_adam(
    positions: Float[Tensor, "n 3"],
    moved: Sequence[AdamState],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"],
    gradients: SplatGradients,
    updates: Int32[Tensor, "n"],
) -> tuple[IsFinite, tuple[Tensor, ...] | None]:
    """Differentiate `decode(positions, *parameters, weights, camera, rows)`, and move these rows, in place.

    `moved` are features, offsets and log-scales; `gradients` those of the decoded splats; `updates` counts the steps of
    each anchor and is incremented in place. Returns whether every gradient of an anchor was finite (if not, some
    anchors may have moved) and the gradients of the decoder's twelve tensors (None where none requires one).
    """
    check_updates(updates, len(positions))
    leaves = [state.parameter[rows].detach().requires_grad_(True) for state in moved]
    decoder = weights.map(lambda t: t.detach().requires_grad_(True))
    with torch.enable_grad():
        source = sources_tensor(gradients.source)
        again = decode_subset(positions[rows], leaves[0], leaves[1], leaves[2], decoder, camera, source)
        outputs = [again.means_px, again.conics, again.colors, again.opacities, again.volumes]
    received = [gradients.means_px, gradients.conics, gradients.colors, gradients.opacities,
                torch.full_like(again.volumes, gradients.volume)]  # fmt: skip
    if gradients.depths is not None:
        outputs, received = [*outputs, again.depths], [*received, gradients.depths]
    found = torch.autograd.grad(outputs, [*leaves, *decoder.tensors()], received)
    counted = updates[rows] + 1
    finite: IsFinite = True
    for state, gradient in zip(moved, found, strict=False):
        finite = adam_rows(state, rows, gradient, counted) & finite
    updates[rows] = counted
    return finite, found[3:] if any(t.requires_grad for t in weights.tensors()) else None
