"""From the gradients of splats to a step of Adam for their anchors on a GPU, in one pass (source/decode.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.argument_checks import check_anchor_shapes, check_splat_gradients
from vdgs.kernels.cuda.decode import ANCHORS_PER_BLOCK, PROGRAM, check_decoder, pack_decoder
from vdgs.kernels.cuda.launch import CudaProgram, KernelArgument, PackedCamera
from vdgs.kernels.kernel_types import HIDDEN_SIZE, AdamState, DecoderWeights, IsFinite, SplatGradients
from vdgs.kernels.splat_segments import SplatMask
from vdgs.kernels.torch_ref.adam import bias_correction_tables, check_indices, check_updates

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
    `chunk` anchors at a time, 1.4 kB each: 88 MB, of which fewer would be launches that take longer than the memory. An
    anchor whose gradient is not finite does not move. `lr_boost` is the same for all of `moved`. Raises ValueError or
    TypeError for unsuitable tensors, CudaUnavailable where the kernel cannot be run.
    """
    _check_arguments(positions, moved, weights, rows, gradients, updates)
    features, offsets, _ = moved
    k, inputs = offsets.parameter.shape[1], weights.opacity.w1.shape[1]
    parts, incoming = _parts(moved), _incoming(gradients)
    v, device, source = len(rows), positions.device, gradients.source
    shown = source if isinstance(source, SplatMask) else SplatMask.of(source, v, k)
    lacking, roots = bias_correction_tables(0.9, 0.999, device, torch.float32)
    broken = torch.zeros(1, dtype=torch.int32, device=device)
    before: list[KernelArgument] = [
        positions.contiguous(), *parts, *(ctypes.c_float(state.learning_rate) for state in moved),
        ctypes.c_float(features.lr_boost), *_weights(weights, k), PackedCamera.of(camera), rows.contiguous(),
    ]  # fmt: skip
    after: list[KernelArgument] = [
        ctypes.c_int(k), ctypes.c_int(inputs), shown.bits, shown.segments.starts,
        *(None if t is None else t.contiguous() for t in incoming),
        ctypes.c_float(gradients.volume), updates, lacking, roots, ctypes.c_int(len(roots)), broken,
    ]  # fmt: skip
    wanted = any(t.requires_grad for t in weights.tensors())
    sums: list[Tensor] = []
    at_once = chunk if wanted else max(v, 1)
    for first in range(0, v, at_once):
        count = min(at_once, v - first)
        made = _DecoderGradientBuffers.empty(count, k, inputs, positions) if wanted else None
        program.launch(
            "move_anchors", (-(-count // ANCHORS_PER_BLOCK),), (32 * ANCHORS_PER_BLOCK,), *before,
            ctypes.c_longlong(first), ctypes.c_longlong(count), *after, *(made or [None] * 4),
        )  # fmt: skip
        if made and sums:
            torch._foreach_add_(sums, made.sums())
        elif made:
            sums = made.sums()
    # What autograd has saved of these no longer holds their values.
    torch.autograd.graph.increment_version([updates, *parts])
    finite = (broken == 0)[0]
    if wanted and not sums:  # nothing is visible
        return finite, tuple(torch.zeros_like(t) for t in weights.tensors())
    return finite, _of_heads(sums, k) if wanted else None


def _check_arguments(
    positions: Tensor, moved: Sequence[AdamState], weights: DecoderWeights, rows: Tensor, gradients: SplatGradients,
    updates: Tensor,
) -> None:  # fmt: skip
    check_updates(updates, len(positions))
    check_indices(rows, len(positions))
    parts = _parts(moved)
    check_anchor_shapes(positions, *parts[: len(moved)])
    check_decoder(moved[1].parameter.shape[1], weights, (positions, *parts))
    if any(not state.parameter.shape == state.first.shape == state.second.shape for state in moved):
        raise ValueError("parameter and moments must be of one shape")
    if len({state.lr_boost for state in moved}) > 1:
        raise ValueError("features, offsets and log-scales must be annealed alike")
    check_splat_gradients(gradients)
    if any(t is not None and t.dtype != torch.float32 for t in _incoming(gradients)):
        raise TypeError("gradients of splats must be float32")


def _parts(moved: Sequence[AdamState]) -> list[Tensor]:
    """Parameters, first and second moments, each of all."""
    return [getattr(state, name) for name in ("parameter", "first", "second") for state in moved]


def _incoming(gradients: SplatGradients) -> tuple[Tensor | None, ...]:
    return gradients.means_px, gradients.conics, gradients.colors, gradients.opacities, gradients.depths


def _weights(weights: DecoderWeights, k: int) -> list[Tensor]:
    """The kernel's layout: first for the forward products, then for the backward ones."""
    heads = weights.opacity, weights.covariance, weights.color
    forward = (tensor for head in pack_decoder(weights, k) for tensor in head)
    back = (w.detach().contiguous() for head in heads for w in (head.w1, head.w2))
    return [*forward, *back]


class _DecoderGradientBuffers(NamedTuple):
    """What each of some visible anchors adds to the gradients of the decoder, the heads beside each other."""

    by_outputs: Float[Tensor, "c 11k"]
    hidden: Float[Tensor, "c 96"]
    by_hidden: Float[Tensor, "c 96"]
    inputs: Float[Tensor, "c inputs"]

    @staticmethod
    def empty(count: int, k: int, inputs: int, like: Tensor) -> _DecoderGradientBuffers:
        widths = (11 * k, 3 * HIDDEN_SIZE, 3 * HIDDEN_SIZE, inputs)
        return _DecoderGradientBuffers(*(like.new_empty(count, width) for width in widths))

    def sums(self) -> list[Tensor]:
        """Of w1 [96, inputs] and b1 [96]; of w2 [11k, 96], in which only the blocks of a head with itself have a
        meaning, and b2 [11k]: four operations instead of twelve, which is what time they take on a card."""
        by_hidden, by_outputs = self.by_hidden, self.by_outputs
        return [by_hidden.t() @ self.inputs, by_hidden.sum(0), by_outputs.t() @ self.hidden, by_outputs.sum(0)]


def _of_heads(sums: Sequence[Tensor], k: int) -> tuple[Tensor, ...]:
    """The gradients of the twelve tensors of the decoder."""
    w1, b1, w2, b2 = sums
    gradients: list[Tensor] = []
    for head, (first, last) in enumerate(((0, k), (k, 8 * k), (8 * k, 11 * k))):
        units = slice(head * HIDDEN_SIZE, (head + 1) * HIDDEN_SIZE)
        gradients += [w1[units], b1[units], w2[first:last, units], b2[first:last]]
    return tuple(gradients)
