"""Anchors to splats in one step on a GPU (source/decode.cu)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cuda.launch import CudaProgram, KernelArgument
from vdgs.kernels.cuda.packed_camera import PackedCamera
from vdgs.kernels.cuda.splat_capacity import SplatCapacity
from vdgs.kernels.kernel_types import (
    FEATURE_SIZE,
    HIDDEN_SIZE,
    AnchorSplats,
    DecoderWeights,
    MlpWeights,
    Splats,
    TrainingSplats,
)
from vdgs.kernels.splat_segments import ANCHORS_PER_SEGMENT, SplatMask, SplatSegments
from vdgs.kernels.torch_ref.decode import decode as by_torch

#: Warps of a block, each with an anchor: kWarps of the source. A lane an offset.
ANCHORS_PER_BLOCK, MAX_OFFSETS = ANCHORS_PER_SEGMENT, 32
PROGRAM = CudaProgram(name="decode.cu", headers=("gaussian_math.h", "image_formation.h"))
CAPACITY = SplatCapacity()


def decode(
    positions: Float[Tensor, "n 3"],
    features: Float[Tensor, "n 32"],
    offsets: Float[Tensor, "n k 3"],
    log_scales: Float[Tensor, "n 6"],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"] | None = None,
    *,
    program: CudaProgram = PROGRAM,
    capacity: SplatCapacity = CAPACITY,
) -> AnchorSplats:
    """As `reference.decode.decode`, for float32 tensors on a CUDA device. Same bits every time.

    Where autograd follows it is the reference that decodes: this has no derivative. Waits for the device once: for how
    many splats there are. They are put into order afterwards (`decode_for_training` does without). Raises ValueError for
    more than 32 offsets, TypeError for other types of elements, CudaUnavailable where the kernel cannot be run.
    """
    anchors = (positions, features, offsets, log_scales)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*anchors, *weights.tensors())):
        return by_torch(*anchors, weights, camera, rows)
    named, shown, _ = _decoded(anchors, weights, camera, rows, True, program, capacity)
    order = shown.segments.order(len(shown))
    return AnchorSplats(**{name: tensor.index_select(0, order) for name, tensor in named.items()})


@torch.no_grad()
def decode_for_training(
    positions: Float[Tensor, "n 3"],
    features: Float[Tensor, "n 32"],
    offsets: Float[Tensor, "n k 3"],
    log_scales: Float[Tensor, "n 6"],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"] | None = None,
    *,
    program: CudaProgram = PROGRAM,
    capacity: SplatCapacity = CAPACITY,
) -> TrainingSplats:
    """As `reference.decode.decode_for_training`, as `decode` in what it asks, waits for and raises.

    Splats are those of `decode` to the bit, but where each block's stand is left to the card: `runs` tells. Sources are
    not written, nor volumes, which are added up in a fixed order. Nothing is kept between anchors and splats.
    """
    anchors = (positions, features, offsets, log_scales)
    named, shown, sums = _decoded(anchors, weights, camera, rows, False, program, capacity)
    return TrainingSplats(**named, segments=shown.segments, source=shown, volume=sums.sum() / len(shown))


@dataclass(frozen=True)
class _DecodeBuffers:
    """Room for m splats, as the kernel takes it; volumes and sources where they are asked for."""

    drawn: Splats
    volumes: Float[Tensor, " m"] | None
    source: Int32[Tensor, " m"] | None

    @staticmethod
    def empty(m: int, whole: bool, like: Tensor) -> _DecodeBuffers:
        new = like.new_empty
        rest = (new(m), new(m, dtype=torch.int32)) if whole else (None, None)
        return _DecodeBuffers(Splats(new(m, 2), new(m, 3), new(m), new(m, 3), new(m)), *rest)

    def tensors(self) -> list[Tensor | None]:
        """In the order of the kernel's arguments."""
        return [*self.named().values(), *([None] * 2 if self.source is None else [])]

    def named(self) -> dict[str, Tensor]:
        """By the names of `AnchorSplats`, as far as they are there."""
        drawn = {field.name: getattr(self.drawn, field.name) for field in fields(Splats)}
        rest = {"volumes": self.volumes, "source": self.source}
        return drawn | {name: tensor for name, tensor in rest.items() if tensor is not None}


def _decoded(
    anchors: tuple[Tensor, ...],
    weights: DecoderWeights,
    camera: Camera,
    rows: Tensor | None,
    whole: bool,
    program: CudaProgram,
    room: SplatCapacity,
) -> tuple[dict[str, Tensor], SplatMask, Float[Tensor, " r"]]:
    """Splats as the card happens to place them (`whole`: with volumes and sources), where they are, and unless `whole`
    the volumes of each run added up."""
    positions, _, offsets, _ = anchors
    k, inputs = offsets.shape[1], weights.opacity.w1.shape[1]
    check_decoder(k, weights, anchors)
    heads = [tensor for head in (weights.opacity, weights.covariance, weights.color) for tensor in pack_head(head, k)]
    count = len(positions) if rows is None else len(rows)
    blocks = -(-count // ANCHORS_PER_BLOCK)
    bits, begins, lengths = (positions.new_empty(n, dtype=torch.int32) for n in (count, blocks, blocks))
    sums = positions.new_empty(blocks)
    given: list[KernelArgument] = [
        *(t.detach().contiguous() for t in anchors), *heads, PackedCamera.of(camera),
        None if rows is None else rows.contiguous(), ctypes.c_longlong(count), ctypes.c_int(k),
        ctypes.c_int(inputs == FEATURE_SIZE + 4),
    ]  # fmt: skip

    def write(capacity: int) -> tuple[_DecodeBuffers, Tensor]:
        made, total = _DecodeBuffers.empty(capacity, whole, positions), positions.new_zeros(1, dtype=torch.int32)
        program.launch(
            "decode_anchors", (blocks,), (32 * ANCHORS_PER_BLOCK,), *given, ctypes.c_int(capacity), total, bits,
            begins, lengths, None if whole else sums, *made.tensors(),
        )  # fmt: skip
        return made, total

    capacity = room.estimate(count, k, positions.device)
    made, total = write(capacity)
    m = int(total) if count else 0
    room.update(count, k, positions.device, m)
    if m > capacity:  # what there was no room for was not written
        made, _ = write(m)
    found = {name: tensor[:m] for name, tensor in made.named().items()}
    return found, SplatMask(bits, SplatSegments(begins, lengths), m, k), sums


def expand_sources(source: Tensor | SplatMask, *, program: CudaProgram = PROGRAM) -> Int32[Tensor, " m"]:
    """What each splat is of, written out if only what shows is known."""
    if isinstance(source, Tensor):
        return source
    made = source.bits.new_empty(len(source))
    count = len(source.bits)
    program.launch(
        "name_splats", (-(-count // ANCHORS_PER_BLOCK),), (32 * ANCHORS_PER_BLOCK,), source.bits,
        source.segments.starts, ctypes.c_longlong(count), ctypes.c_int(source.offsets), made,
    )  # fmt: skip
    return made


def pack_head(head: MlpWeights, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A head as the kernels take it forwards, so that neighbouring lanes read neighbouring numbers: w1 [inputs, 32],
    b1 [32], w2 [32, c, k], b2 [c, k], with c outputs an offset."""
    w1, b1, w2, b2 = (tensor.detach() for tensor in head.tensors())
    by_offset = w2.reshape(k, -1, HIDDEN_SIZE).permute(2, 1, 0), b2.reshape(k, -1).t()
    return w1.t().contiguous(), b1.contiguous(), by_offset[0].contiguous(), by_offset[1].contiguous()


def check_decoder(k: int, weights: DecoderWeights, anchors: Sequence[Tensor]) -> None:
    """Raise a clear error unless a warp can decode anchors of so many offsets, and all numbers are float32."""
    inputs = weights.opacity.w1.shape[1]
    if not 1 <= k <= MAX_OFFSETS:
        raise ValueError(f"offsets per anchor must be 1 to {MAX_OFFSETS}, not {k}")
    if inputs not in (FEATURE_SIZE + 3, FEATURE_SIZE + 4):
        raise ValueError(f"a head's first layer must be 35 or 36 wide, not {inputs}")
    if any(t.dtype != torch.float32 for t in (*anchors, *weights.tensors())):
        raise TypeError("anchors and decoder must be float32")
