"""Anchors to splats in one step on a GPU (source/decode.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.kernels.cuda.camera import PackedCamera
from vdgs.kernels.cuda.launching import Argument, Program
from vdgs.kernels.reference.decode import decode as by_torch
from vdgs.kernels.types import FEATURE_SIZE, HIDDEN_SIZE, AnchorSplats, DecoderWeights, HeadWeights

#: Warps of a block, each with an anchor: kWarps of the source. A lane an offset.
ANCHORS_OF_A_BLOCK, MOST_OFFSETS = 8, 32
PROGRAM = Program("decode.cu", headers=("gaussian_math.h", "image_formation.h"))


def decode(
    positions: Float[Tensor, "n 3"],
    features: Float[Tensor, "n 32"],
    offsets: Float[Tensor, "n k 3"],
    log_scales: Float[Tensor, "n 6"],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"] | None = None,
    *,
    program: Program = PROGRAM,
) -> AnchorSplats:
    """As `reference.decode.decode`, for float32 tensors on a CUDA device. Same bits every time.

    Where autograd follows it is the reference that decodes: this has no derivative. Waits for the device once: for how
    many splats room must be made. Nothing is kept between anchors and splats. Raises ValueError for more than 32
    offsets, TypeError for other types of elements, CudaUnavailable where the kernel cannot be run.
    """
    anchors = (positions, features, offsets, log_scales)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*anchors, *weights.tensors())):
        return by_torch(*anchors, weights, camera, rows)
    k, inputs = offsets.shape[1], weights.opacity.w1.shape[1]
    check_decoder(k, weights, anchors)
    heads = [tensor for head in (weights.opacity, weights.covariance, weights.colour) for tensor in by_lanes(head, k)]
    count = len(positions) if rows is None else len(rows)
    given: list[Argument] = [
        *(t.detach().contiguous() for t in anchors), *heads, PackedCamera.of(camera),
        None if rows is None else rows.contiguous(), ctypes.c_longlong(count), ctypes.c_int(k),
        ctypes.c_int(inputs == FEATURE_SIZE + 4),
    ]  # fmt: skip
    grid, block = (-(-count // ANCHORS_OF_A_BLOCK),), (32 * ANCHORS_OF_A_BLOCK,)
    shown, counts = (positions.new_empty(count, dtype=torch.int32) for _ in range(2))
    program.launch("decode_anchors", grid, block, *given, shown, counts, *[None] * 8)
    ends = counts.cumsum(0, dtype=torch.int32)
    m = int(ends[-1]) if count else 0
    empty = positions.new_empty
    splats = AnchorSplats(
        empty(m, 2), empty(m, 3), empty(m), empty(m, 3), empty(m), empty(m), empty(m, dtype=torch.int32)
    )
    program.launch(
        "decode_anchors", grid, block, *given, shown, None, ends, splats.means_px, splats.conics, splats.depths,
        splats.colours, splats.opacities, splats.volumes, splats.source,
    )  # fmt: skip
    return splats


def by_lanes(head: HeadWeights, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A head as the kernels take it forwards, so that neighbouring lanes read neighbouring numbers: w1 [inputs, 32],
    b1 [32], w2 [32, c, k], b2 [c, k], with c outputs an offset."""
    w1, b1, w2, b2 = (tensor.detach() for tensor in head.tensors())
    by_offset = w2.reshape(k, -1, HIDDEN_SIZE).permute(2, 1, 0), b2.reshape(k, -1).t()
    return w1.t().contiguous(), b1.contiguous(), by_offset[0].contiguous(), by_offset[1].contiguous()


def check_decoder(k: int, weights: DecoderWeights, anchors: Sequence[Tensor]) -> None:
    """Raise a clear error unless a warp can decode anchors of so many offsets, and all numbers are float32."""
    inputs = weights.opacity.w1.shape[1]
    if not 1 <= k <= MOST_OFFSETS:
        raise ValueError(f"offsets per anchor must be 1 to {MOST_OFFSETS}, not {k}")
    if inputs not in (FEATURE_SIZE + 3, FEATURE_SIZE + 4):
        raise ValueError(f"a head's first layer must be 35 or 36 wide, not {inputs}")
    if any(t.dtype != torch.float32 for t in (*anchors, *weights.tensors())):
        raise TypeError("anchors and decoder must be float32")
