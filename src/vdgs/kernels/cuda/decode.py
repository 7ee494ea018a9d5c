"""Anchors to splats in one step on a GPU (source/decode.cu)."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from functools import cache
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.argument_checks import check_anchor_shapes, check_offset_count
from vdgs.kernels.cuda.launch import CudaProgram, KernelArgument, PackedCamera
from vdgs.kernels.kernel_types import (
    FEATURE_SIZE,
    HIDDEN_SIZE,
    SPLAT_TENSORS,
    AnchorSplats,
    DecoderWeights,
    MlpWeights,
    TrainingSplats,
)
from vdgs.kernels.splat_segments import ANCHORS_PER_SEGMENT, SplatMask, SplatSegments
from vdgs.kernels.torch_ref.adam import check_indices
from vdgs.kernels.torch_ref.decode import decode as torch_decode

#: Warps of a block, each with an anchor: kWarps of the source. A lane an offset.
ANCHORS_PER_BLOCK, MAX_OFFSETS = ANCHORS_PER_SEGMENT, 32
PROGRAM = CudaProgram(name="decode.cu", headers=("gaussian_math.h", "image_formation.h"))
#: Memory beyond what earlier views needed, as a factor and in splats.
MARGIN_FACTOR, MARGIN_SPLATS = 1.125, 256
#: The need of a view counts this much less with each later one.
DECAY = 0.98


class SplatCapacity:
    """How many splats to allocate before their number is known: per anchor in view and device, the most that recent
    views needed. An estimate costs memory or a second pass, never a bit of the result."""

    def __init__(self) -> None:
        self._shares: dict[tuple[str, int], float] = {}

    def estimate(self, count: int, offsets: int, device: torch.device) -> int:
        """Splats to allocate for `count` anchors of `offsets` each: half of them before the first view."""
        share = self._shares.get((str(device), offsets), offsets / 2)
        return min(int(MARGIN_FACTOR * share * count) + MARGIN_SPLATS, count * offsets)

    def update(self, count: int, offsets: int, device: torch.device, splats: int) -> None:
        """Record the number of splats of a view."""
        if count:
            key = str(device), offsets
            self._shares[key] = max(splats / count, DECAY * self._shares.get(key, 0.0))


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
    """As `torch_ref.decode`, for float32 tensors on a CUDA device; `torch_ref` itself where autograd follows.

    Deterministic. Waits for the device once, for the number of splats, which are then sorted. Raises ValueError for
    shapes that do not match, k > 32 or 2^31 offsets in view, TypeError for other dtypes, CudaUnavailable where the
    kernel cannot be run.
    """
    anchors = (positions, features, offsets, log_scales)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*anchors, *weights.tensors())):
        return torch_decode(*anchors, weights, camera, rows)
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
    """As `torch_ref.decode_for_training`; requirements, waits and errors are those of `decode`.

    The splats equal those of `decode` to the bit, in the order of `segments`. Volumes are summed in a fixed order.
    """
    anchors = (positions, features, offsets, log_scales)
    named, shown, sums = _decoded(anchors, weights, camera, rows, False, program, capacity)
    return TrainingSplats(**named, segments=shown.segments, source=shown, volume=sums.sum() / len(shown))


def _decode_buffers(m: int, whole: bool, like: Tensor) -> dict[str, Tensor]:
    """Memory for m splats by field of `AnchorSplats`, in the kernel's order; volumes and sources only if `whole`."""
    shapes = dict(zip(SPLAT_TENSORS, ((m, 2), (m, 3), (m,), (m, 3), (m,)), strict=True))
    made = {name: like.new_empty(shape) for name, shape in (shapes | ({"volumes": (m,)} if whole else {})).items()}
    return made | ({"source": like.new_empty(m, dtype=torch.int32)} if whole else {})


def _decoded(
    anchors: tuple[Tensor, ...],
    weights: DecoderWeights,
    camera: Camera,
    rows: Tensor | None,
    whole: bool,
    program: CudaProgram,
    splat_capacity: SplatCapacity,
) -> tuple[dict[str, Tensor], SplatMask, Float[Tensor, " r"]]:
    """Splats as the GPU happens to place them (`whole`: with volumes and sources), their mask and segments, and unless
    `whole` the sum of volumes of each segment."""
    positions, _, offsets, _ = anchors
    k, inputs = offsets.shape[1], weights.opacity.w1.shape[1]
    check_anchor_shapes(*anchors)
    check_decoder(k, weights, anchors)
    if rows is not None:
        check_indices(rows, len(positions))
    count = len(positions) if rows is None else len(rows)
    check_offset_count(count, k)
    heads = [tensor for head in pack_decoder(weights, k) for tensor in head]
    blocks = -(-count // ANCHORS_PER_BLOCK)
    bits, begins, lengths = (positions.new_empty(n, dtype=torch.int32) for n in (count, blocks, blocks))
    sums = positions.new_empty(blocks)
    given: list[KernelArgument] = [
        *(t.detach().contiguous() for t in anchors), *heads, PackedCamera.of(camera),
        None if rows is None else rows.contiguous(), ctypes.c_longlong(count), ctypes.c_int(k),
        ctypes.c_int(inputs == FEATURE_SIZE + 4),
    ]  # fmt: skip

    def write(capacity: int) -> tuple[dict[str, Tensor], Tensor]:
        made, total = _decode_buffers(capacity, whole, positions), positions.new_zeros(1, dtype=torch.int32)
        program.launch(
            "decode_anchors", (blocks,), (32 * ANCHORS_PER_BLOCK,), *given, ctypes.c_int(capacity), total, bits,
            begins, lengths, None if whole else sums, *made.values(), *([] if whole else [None, None]),
        )  # fmt: skip
        return made, total

    capacity = splat_capacity.estimate(count, k, positions.device)
    made, total = write(capacity)
    m = int(total) if count else 0
    splat_capacity.update(count, k, positions.device, m)
    if m > capacity:  # what there was no room for was not written
        made, _ = write(m)
    splats = {name: tensor[:m] for name, tensor in made.items()}
    return splats, SplatMask(bits, SplatSegments(begins, lengths), m, k), sums


def expand_sources(source: Tensor | SplatMask, *, program: CudaProgram = PROGRAM) -> Int32[Tensor, " m"]:
    """The source of each splat, expanded from a `SplatMask`."""
    if isinstance(source, Tensor):
        return source
    made = source.bits.new_empty(len(source))
    count = len(source.bits)
    program.launch(
        "name_splats", (-(-count // ANCHORS_PER_BLOCK),), (32 * ANCHORS_PER_BLOCK,), source.bits,
        source.segments.starts, ctypes.c_longlong(count), ctypes.c_int(source.offsets), made,
    )  # fmt: skip
    return made


#: Packed weights, with k and the versions of the tensors: a step decodes by them, and moves anchors by them.
_packed: WeakKeyDictionary[DecoderWeights, tuple[tuple[int, ...], list[tuple[Tensor, ...]]]] = WeakKeyDictionary()


def pack_decoder(weights: DecoderWeights, k: int) -> list[tuple[Tensor, ...]]:
    """`pack_head` of the three heads, kept as long as the weights are there and unchanged."""
    # A tensor of inference mode has no version, and is never kept beyond a view.
    key = (k, *(0 if tensor.is_inference() else tensor._version for tensor in weights.tensors()))
    known, packed = _packed.get(weights, ((), []))
    if known != key:
        packed = _pack(weights, k)
        _packed[weights] = key, packed
    return packed


def _pack(weights: DecoderWeights, k: int) -> list[tuple[Tensor, ...]]:
    """`pack_head` of each head by one gather: its dozen copies would be a dozen launches."""
    tensors = [tensor.detach() for tensor in weights.tensors()]
    order, shapes = packing_order(k, weights.opacity.w1.shape[1], tensors[0].device)
    gathered = torch.cat([tensor.reshape(-1) for tensor in tensors]).index_select(0, order)
    made = [part.view(shape) for part, shape in zip(gathered.split([*map(math.prod, shapes)]), shapes, strict=True)]
    return [tuple(made[head : head + 4]) for head in range(0, len(made), 4)]


@cache
def decoder_shapes(k: int, inputs: int) -> tuple[tuple[int, ...], ...]:
    """Of the twelve tensors of a decoder of anchors with k offsets."""
    hidden = (HIDDEN_SIZE, inputs), (HIDDEN_SIZE,)
    return tuple(shape for c in (1, 7, 3) for shape in (*hidden, (c * k, HIDDEN_SIZE), (c * k,)))


@cache
def packing_order(k: int, inputs: int, device: torch.device) -> tuple[Int64[Tensor, " w"], tuple[tuple[int, ...], ...]]:
    """Which number of a decoder's tensors, one after the other, is which number of the packed ones; their shapes."""
    sizes = decoder_shapes(k, inputs)
    places = torch.arange(sum(map(math.prod, sizes)), dtype=torch.float64, device="cpu").split([*map(math.prod, sizes)])
    named = [part.view(size) for part, size in zip(places, sizes, strict=True)]
    heads = [MlpWeights(*named[first : first + 4]) for first in range(0, len(named), 4)]
    packed = [tensor for head in heads for tensor in pack_head(head, k)]
    return torch.cat([tensor.flatten() for tensor in packed]).long().to(device), tuple(tuple(t.shape) for t in packed)


def pack_head(head: MlpWeights, k: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A head for the forward kernels, coalesced: w1 [inputs, 32], b1 [32], w2 [32, c, k], b2 [c, k] for c outputs an
    offset."""
    w1, b1, w2, b2 = (tensor.detach() for tensor in head.tensors())
    by_offset = w2.reshape(k, -1, HIDDEN_SIZE).permute(2, 1, 0), b2.reshape(k, -1).t()
    return w1.t().contiguous(), b1.contiguous(), by_offset[0].contiguous(), by_offset[1].contiguous()


def check_decoder(k: int, weights: DecoderWeights, anchors: Sequence[Tensor]) -> None:
    """Raise a clear error unless a warp can decode anchors of so many offsets by these weights, and all numbers are
    float32."""
    inputs = weights.opacity.w1.shape[1]
    if not 1 <= k <= MAX_OFFSETS:
        raise ValueError(f"offsets per anchor must be 1 to {MAX_OFFSETS}, not {k}")
    if inputs not in (FEATURE_SIZE + 3, FEATURE_SIZE + 4):
        raise ValueError(f"a head's first layer must be 35 or 36 wide, not {inputs}")
    if tuple(tuple(t.shape) for t in weights.tensors()) != decoder_shapes(k, inputs):
        raise ValueError(f"a head must be [32, 35 or 36], [32], [outputs, 32], [outputs] for {k} offsets an anchor")
    if any(t.dtype != torch.float32 for t in (*anchors, *weights.tensors())):
        raise TypeError("anchors and decoder must be float32")
