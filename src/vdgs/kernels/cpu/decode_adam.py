"""From the gradients of splats to a step of Adam for their anchors in one pass, in C++."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.argument_checks import check_splat_gradients
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.adam import round_factors
from vdgs.kernels.cpu.arguments import contiguous, packed_camera
from vdgs.kernels.cpu.decode import check_anchors
from vdgs.kernels.kernel_types import AdamState, DecoderWeights, SplatGradients
from vdgs.kernels.splat_segments import sources_tensor
from vdgs.kernels.torch_ref.adam import check_indices, check_updates, step_factors
from vdgs.kernels.torch_ref.statistics import check_sources


def decode_backward_adam(
    positions: Float[Tensor, "n 3"],
    moved: Sequence[AdamState],
    weights: DecoderWeights,
    camera: Camera,
    rows: Int64[Tensor, "v"],
    gradients: SplatGradients,
    updates: Int32[Tensor, "n"],
) -> tuple[bool, tuple[Tensor, ...] | None]:
    """As `torch_ref.decode_backward_adam`, for contiguous float32 parameters and moments.

    An anchor moves as soon as its gradient is known. The bits are those of `decode` with autograd and `adam_rows`, for
    any number of threads. Raises ValueError, TypeError or IndexError for unsuitable arguments, before any change.
    """
    features, offsets, log_scales = (state.parameter for state in moved)
    check_anchors(positions, features, offsets, log_scales)
    check_indices(rows, len(positions))
    check_updates(updates, len(positions))
    if not updates.is_contiguous():
        raise ValueError("updates must be contiguous")
    for state in moved:
        for tensor in state[:3]:
            if tensor.dtype != torch.float32 or not tensor.is_contiguous() or tensor.shape != state.parameter.shape:
                raise ValueError("parameter and moments must be contiguous float32 of one shape")
    source = sources_tensor(gradients.source)
    check_sources(source, rows, offsets.shape[1])
    check_splat_gradients(gradients)
    steps = [_step(state) for state in moved]
    heads = [contiguous(t.detach()) for t in weights.tensors()]
    incoming = (gradients.means_px, gradients.conics, gradients.colors, gradients.opacities)
    wanted = any(t.requires_grad for t in weights.tensors())
    found = [torch.empty_like(t) for t in heads] if wanted else None
    finite: bool = extension.get_extension().decode_backward_adam(
        [contiguous(positions.detach()), *(state[0] for state in steps)], rows.contiguous(), heads,
        packed_camera(camera), source, contiguous(gradients.color_values),
        contiguous(gradients.opacity_values), [contiguous(t) for t in incoming], gradients.volume, steps, updates,
        found, *([] if gradients.depths is None else [contiguous(gradients.depths)]),
    )  # fmt: skip
    # What autograd has saved of these no longer holds their values.
    torch.autograd.graph.increment_version([updates, *(t for state in moved for t in state[:3])])
    return finite, tuple(found) if found is not None else None


def _step(state: AdamState) -> tuple[Any, ...]:
    """A parameter and its moments, the tables of its step, and the betas with epsilon."""
    rates, roots, *rest = round_factors(step_factors(state.learning_rate, None, lr_boost=state.lr_boost))
    return (*(t.detach() for t in state[:3]), rates, roots, rest)
