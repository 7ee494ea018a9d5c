"""From the gradients of splats to a step of Adam for their anchors on a GPU, in one pass (source/decode.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.kernels.cuda.camera import PackedCamera
from vdgs.kernels.cuda.decode import ANCHORS_OF_A_BLOCK, PROGRAM, check_decoder
from vdgs.kernels.cuda.launching import Argument, Program
from vdgs.kernels.reference.adam import check_updates, tables_on
from vdgs.kernels.reference.decode_adam import decode_backward_adam as by_torch
from vdgs.kernels.types import AdamState, DecoderWeights, Finite, HeadWeights, SplatGradients


def decode_backward_adam(
    positions: Float[Tensor, "n 3"],
    moved: Sequence[AdamState],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"],
    gradients: SplatGradients,
    updates: Int32[Tensor, "n"],
    *,
    program: Program = PROGRAM,
) -> tuple[Finite, tuple[Tensor, ...] | None]:
    """As `reference.decode_adam.decode_backward_adam`, for float32 tensors on a CUDA device.

    Gradients of anchors are never held: a warp takes an anchor from its splats to its new place. Those of the decoder
    are matrix products (by torch) of what each anchor adds, for which some 1.4 kB a visible anchor are taken; where
    nobody wants them, nothing. Nothing waits for the device, and whether all was finite stays there: an anchor for
    which it is not does not move. Of gradients by depth the kernel knows nothing: with them, torch does it all. All of
    `moved` anneal alike (`AdamState.early`). Raises ValueError or TypeError for unsuitable tensors, CudaUnavailable
    where the kernel cannot be run.
    """
    if gradients.depths is not None:
        return by_torch(positions, moved, weights, camera, rows, gradients, updates)
    check_updates(updates, len(positions))
    features, offsets, _ = moved
    k, inputs = offsets.parameter.shape[1], weights.opacity.w1.shape[1]
    parts = [getattr(state, name) for name in ("parameter", "first", "second") for state in moved]
    check_decoder(k, weights, (positions, *parts))
    if len({state.early for state in moved}) > 1:
        raise ValueError("features, offsets and log-scales must be annealed alike")
    v, device, source = len(rows), positions.device, gradients.source
    begins = torch.searchsorted(source, (torch.arange(v + 1, device=device) * k).to(torch.int32))
    lacking, roots = (table.float() for table in tables_on(0.9, 0.999, device))
    broken = torch.zeros(1, dtype=torch.int32, device=device)
    wanted = any(t.requires_grad for t in weights.tensors())
    made = _Made.empty(v, k, inputs, positions) if wanted else None
    given: list[Argument] = [
        *(t.contiguous() for t in (gradients.means_px, gradients.conics, gradients.colours, gradients.opacities)),
        ctypes.c_float(gradients.volume), source.contiguous(), gradients.colour_values.contiguous(),
        gradients.opacity_values.contiguous(),
    ]  # fmt: skip
    program.launch(
        "move_anchors", (-(-v // ANCHORS_OF_A_BLOCK),), (32 * ANCHORS_OF_A_BLOCK,), positions.contiguous(), *parts,
        *(ctypes.c_float(state.learning_rate) for state in moved), ctypes.c_float(features.early), *_weights(weights),
        PackedCamera.of(camera), rows.contiguous(), ctypes.c_longlong(v), ctypes.c_int(k), ctypes.c_int(inputs), begins,
        *given, updates, lacking, roots, ctypes.c_int(len(roots)), broken, *(made.tensors() if made else [None] * 6),
    )  # fmt: skip
    return (broken == 0).all(), made.gradients() if made else None


def _weights(weights: DecoderWeights) -> list[Tensor]:
    """As the kernel takes them: as they are multiplied forwards, then as they are multiplied backwards."""

    def across(tensor: Tensor) -> Tensor:
        return tensor.detach().t().contiguous()

    o, c, r = weights.opacity, weights.covariance, weights.colour
    forwards = [across(o.w1), o.b1, across(c.w1), c.b1, across(c.w2), c.b2, across(r.w1), r.b1]
    return [t.detach().contiguous() for t in (*forwards, *(w for head in (o, c, r) for w in (head.w1, head.w2)))]


class _Made:
    """What each visible anchor adds to the gradients of the decoder."""

    def __init__(self, by_outputs: tuple[Tensor, ...], hidden: Tensor, by_hidden: Tensor, inputs: Tensor):
        self.by_outputs, self.hidden, self.by_hidden, self.inputs = by_outputs, hidden, by_hidden, inputs

    @staticmethod
    def empty(v: int, k: int, inputs: int, like: Tensor) -> _Made:
        by_outputs = tuple(like.new_empty(v, outputs * k) for outputs in (1, 7, 3))
        return _Made(by_outputs, like.new_empty(3, v, 32), like.new_empty(3, v, 32), like.new_empty(v, inputs))

    def tensors(self) -> list[Tensor]:
        return [*self.by_outputs, self.hidden, self.by_hidden, self.inputs]

    def gradients(self) -> tuple[Tensor, ...]:
        """Of the twelve tensors of the decoder."""
        heads = zip(self.by_outputs, self.hidden, self.by_hidden, strict=True)
        return DecoderWeights(
            *(
                HeadWeights(by_hidden.t() @ self.inputs, by_hidden.sum(0), by_output.t() @ hidden, by_output.sum(0))
                for by_output, hidden, by_hidden in heads
            )
        ).tensors()
