"""Anchors to splats in one fused step, in C++; see `vdgs.kernels.torch_ref.decode`."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.argument_checks import check_anchor_shapes, check_offset_count
from vdgs.kernels.autograd import once_differentiable
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import contiguous, packed_camera
from vdgs.kernels.kernel_types import AnchorSplats, DecoderWeights, TrainingSplats
from vdgs.kernels.torch_ref.adam import check_indices


def decode(
    positions: Float[Tensor, "n 3"],
    features: Float[Tensor, "n 32"],
    offsets: Float[Tensor, "n k 3"],
    log_scales: Float[Tensor, "n 6"],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"] | None = None,
) -> AnchorSplats:
    """As `torch_ref.decode`, in float32.

    Backward computes hidden layers again, and only the gradients that are needed; same bits for any number of threads.
    `rows` ascend without repetition; anchors are gathered only if autograd follows. Raises ValueError for shapes that
    do not match, k > 32 or 2^31 offsets in view, IndexError for a row outside the anchors, RuntimeError for second
    derivatives.
    """
    check_anchors(positions, features, offsets, log_scales)
    check_offset_count(len(positions if rows is None else rows), offsets.shape[1])
    tensors: tuple[Tensor, ...] = (positions.detach(), features, offsets, log_scales)
    if rows is not None:
        check_indices(rows, len(positions))
        rows = rows.contiguous()
        if torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, *weights.tensors())):
            tensors, rows = tuple(t[rows] for t in tensors), None
    anchors = (contiguous(t) for t in tensors)
    heads = (contiguous(t) for t in weights.tensors())
    *projected, volumes, source = _Decode.apply(packed_camera(camera), rows, *anchors, *heads)
    return AnchorSplats(*projected, volumes=volumes, source=source)


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
    """As `torch_ref.decode_for_training`, by `decode`."""
    return TrainingSplats.of(decode(positions, features, offsets, log_scales, weights, camera, rows))


def check_anchors(positions: Tensor, features: Tensor, offsets: Tensor, log_scales: Tensor) -> None:
    """Raise ValueError where the tensors of anchors do not belong together or k > 32."""
    k = offsets.shape[1]
    if not 1 <= k <= extension.get_extension().max_offsets:
        raise ValueError(f"offsets per anchor must be 1 to {extension.get_extension().max_offsets}, not {k}")
    check_anchor_shapes(positions, features, offsets, log_scales)


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, camera: Tensor, rows: Tensor | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        inputs = [t.detach() for t in tensors]
        *splats, source = map(torch.from_numpy, extension.get_extension().decode(inputs[:4], rows, inputs[4:], camera))
        ctx.save_for_backward(camera, *tensors, source, splats[3], splats[4])
        ctx.mark_non_differentiable(source)
        ctx.set_materialize_grads(False)
        return *splats, source

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        camera, *inputs, source, colors, opacities = (t.detach() for t in ctx.saved_tensors)
        wanted = ctx.needs_input_grad[2:]
        out = [torch.empty_like(t) if want else None for t, want in zip(inputs[1:4], wanted[1:4], strict=True)]
        # The gradients of the weights come together or not at all.
        weights = [torch.empty_like(t) for t in inputs[4:]] if any(wanted[4:]) else None
        nothing: list[Tensor | None] = [None] * 12
        incoming = [None if g is None else g.contiguous() for g in gradients[:6]]
        extension.get_extension().decode_backward(
            inputs[:4], inputs[4:], camera, source, colors, opacities, incoming, out, weights
        )
        return None, None, None, *out, *(weights or nothing)
