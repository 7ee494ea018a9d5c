"""Splats of merged Gaussians in C++, straight from numbers in half precision: sixteen Gaussians side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate

import numpy as np
import torch
from torch import Tensor

from vdgs.geometry.camera import Camera
from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import contiguous, new_floats, packed_camera
from vdgs.kernels.kernel_types import SPLAT_TENSORS, MergedGaussians, Splats
from vdgs.kernels.spherical_harmonics import num_sh_bases


def merged_splats(parts: Sequence[MergedGaussians], camera: Camera, before: Splats | None = None) -> Splats:
    """As `torch_ref.merged_splats`, in float32. Same bits for any number of threads, and for numbers that are given in
    half precision or as float32. Raises ValueError for shapes that do not match."""
    first = 0 if before is None else len(before.depths)
    ends = list(accumulate((len(part.means) for part in parts), initial=first))
    splats = Splats(*(new_floats(ends[-1], *shape) for shape in ((2,), (3,), (), (3,), ())))
    for name in SPLAT_TENSORS if before is not None else ():
        getattr(splats, name)[:first] = getattr(before, name)
    packed = packed_camera(camera)
    for part, begin, end in zip(parts, ends, ends[1:], strict=False):
        _draw(part, packed, [getattr(splats, name)[begin:end] for name in SPLAT_TENSORS])
    return splats


def _draw(part: MergedGaussians, camera: Tensor, tensors: list[Tensor]) -> None:
    """The splats of a part, into these tensors."""
    means, others = part.means, part[1:-1]
    factors = part.covers[:0] if part.opacity_factors is None else part.opacity_factors
    n, degree = len(means), math.isqrt(part.shN.shape[1] + 1) - 1
    shapes = [(n, 3), (n, 3), (n, 4), (n,), (n, 3), (n, num_sh_bases(degree) - 1, 3), (n,), (n,), (n,), (n, 3)]
    found = [tuple(tensor.shape) for tensor in (means, *others)]
    if found != shapes or (part.opacity_factors is not None and tuple(factors.shape) != (n,)):
        raise ValueError(f"merged Gaussians must be {shapes}, not {found}, with {n} factors or none")
    native, columns = extension.get_extension(), [*others, factors]
    # As arrays of numpy: to hand tensors over takes as long again as all else of a small call.
    if all(tensor.dtype == torch.float16 for tensor in columns):
        draw, arrays = native.merged_splats_of_halves, [t.contiguous().numpy().view(np.uint16) for t in columns]
    else:
        draw, arrays = native.merged_splats, [contiguous(tensor).numpy() for tensor in columns]
    draw(contiguous(means).numpy(), *arrays, camera.numpy(), degree, *(tensor.numpy() for tensor in tensors))
