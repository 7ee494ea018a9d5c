"""From the gradients of splats to a step of Adam for their anchors on a GPU, in one pass (source/decode.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cuda.decode import ANCHORS_PER_BLOCK, PROGRAM, check_decoder, expand_sources, pack_head
from vdgs.kernels.cuda.launch import CudaProgram, KernelArgument, PackedCamera
from vdgs.kernels.kernel_types import AdamState, DecoderWeights, IsFinite, SplatGradients
from vdgs.kernels.splat_segments import SplatMask
from vdgs.kernels.torch_ref.adam import bias_correction_tables, check_updates
from vdgs.kernels.torch_ref.decode_adam import decode_backward_adam as torch_decode_backward_adam

#: Anchors whose contributions to the decoder's gradients are stored at once: whole blocks.
ANCHORS_PER_CHUNK = 2**16


def decode_backward_adam(
    positions: Float[Tensor, "n 3"],
    moved: Sequence[AdamState],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"],
    gradients: SplatGradients,
    updates: Int32[Tensor, "n"],
    *,
    program: CudaProgram = PROGRAM,
    chunk: int = ANCHORS_PER_CHUNK,
) -> tuple[IsFinite, tuple[Tensor, ...] | None]:
    """As `torch_ref.decode_backward_adam`, for float32 tensors on a CUDA device, without waiting for it.

    A warp moves an anchor; its gradients are never stored. Gradients of the decoder are matrix products (by torch) over
    `chunk` anchors at a time, 1.4 kB each (88 MB: fewer would be launches that cost more than the memory's time). An anchor whose gradient is not finite
    does not move. With gradients by depth, torch computes everything. `lr_boost` is the same for all of `moved`. Raises
    ValueError or TypeError for unsuitable tensors, CudaUnavailable where the kernel cannot be run.
    """
    if gradients.depths is not None:
        named = replace(gradients, source=expand_sources(gradients.source, program=program))
        return torch_decode_backward_adam(positions, moved, weights, camera, rows, named, updates)
    check_updates(updates, len(positions))
    features, offsets, _ = moved
    k, inputs = offsets.parameter.shape[1], weights.opacity.w1.shape[1]
    parts = [getattr(state, name) for name in ("parameter", "first", "second") for state in moved]
    check_decoder(k, weights, (positions, *parts))
    if len({state.lr_boost for state in moved}) > 1:
        raise ValueError("features, offsets and log-scales must be annealed alike")
    v, device, source = len(rows), positions.device, gradients.source
    shown = source if isinstance(source, SplatMask) else SplatMask.of(source, v, k)
    lacking, roots = (table.float() for table in bias_correction_tables(0.9, 0.999, device))
    broken = torch.zeros(1, dtype=torch.int32, device=device)
    before: list[KernelArgument] = [
        positions.contiguous(), *parts, *(ctypes.c_float(state.learning_rate) for state in moved),
        ctypes.c_float(features.lr_boost), *_weights(weights, k), PackedCamera.of(camera), rows.contiguous(),
    ]  # fmt: skip
    after: list[KernelArgument] = [
        ctypes.c_int(k), ctypes.c_int(inputs), shown.bits, shown.segments.starts,
        *(t.contiguous() for t in (gradients.means_px, gradients.conics, gradients.colors, gradients.opacities)),
        ctypes.c_float(gradients.volume), updates, lacking, roots, ctypes.c_int(len(roots)), broken,
    ]  # fmt: skip
    wanted = any(t.requires_grad for t in weights.tensors())
    of_weights: list[Tensor] = []
    at_once = chunk if wanted else max(v, 1)
    for first in range(0, v, at_once):
        count = min(at_once, v - first)
        made = _DecoderGradientBuffers.empty(count, k, inputs, positions) if wanted else None
        program.launch(
            "move_anchors", (-(-count // ANCHORS_PER_BLOCK),), (32 * ANCHORS_PER_BLOCK,), *before,
            ctypes.c_longlong(first), ctypes.c_longlong(count), *after, *(made.tensors() if made else [None] * 6),
        )  # fmt: skip
        if made and of_weights:
            torch._foreach_add_(of_weights, made.gradients())
        elif made:
            of_weights = list(made.gradients())
    if wanted and not of_weights:
        of_weights = [torch.zeros_like(t) for t in weights.tensors()]
    return (broken == 0)[0], tuple(of_weights) if wanted else None


def _weights(weights: DecoderWeights, k: int) -> list[Tensor]:
    """The kernel's layout: first for the forward products, then for the backward ones."""
    heads = weights.opacity, weights.covariance, weights.color
    opacity, covariance, color = (pack_head(head, k) for head in heads)
    back = (w.detach().contiguous() for head in heads for w in (head.w1, head.w2))
    return [*opacity, *covariance, *color, *back]


class _DecoderGradientBuffers(NamedTuple):
    """What each of some visible anchors adds to the gradients of the decoder."""

    by_outputs: tuple[Tensor, ...]
    hidden: Tensor
    by_hidden: Tensor
    inputs: Tensor

    @staticmethod
    def empty(count: int, k: int, inputs: int, like: Tensor) -> _DecoderGradientBuffers:
        by_outputs = tuple(like.new_empty(count, outputs * k) for outputs in (1, 7, 3))
        hidden, by_hidden = (like.new_empty(3, count, 32) for _ in range(2))
        return _DecoderGradientBuffers(by_outputs, hidden, by_hidden, like.new_empty(count, inputs))

    def tensors(self) -> list[Tensor]:
        return [*self.by_outputs, self.hidden, self.by_hidden, self.inputs]

    def gradients(self) -> tuple[Tensor, ...]:
        """Of the twelve tensors of the decoder."""
        heads = zip(self.by_outputs, self.hidden, self.by_hidden, strict=True)
        by_head = (
            (b.t() @ self.inputs, b.sum(0), outputs.t() @ hidden, outputs.sum(0)) for outputs, hidden, b in heads
        )
        return tuple(gradient for gradients in by_head for gradient in gradients)
