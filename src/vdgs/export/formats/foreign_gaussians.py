"""What files of other programs hold and those of vdgs never do: filters, other ways to draw, numbers that are none.

What is changed or cannot be kept is said as a warning of Python: only Python reads such files.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.model.gaussians import Gaussians

#: What stands for infinite logits of opacities, and for the logarithms of sizes that are zero (choice): beyond what a
#: float32 opacity tells from 0 and 1, and nanometres.
LARGEST_LOGIT, SMALLEST_LOG_SCALE = 16.0, -20.0


def fused_filter(gaussians: Gaussians, filter_3d: Float[Tensor, " n"]) -> Gaussians:
    """Gaussians convolved with the filter that Mip-Splatting stores beside them, a standard deviation in units.

    They grow, and their opacities fall by what they grow: Yu, Chen, Huang, Sattler and Geiger, "Mip-Splatting", 2024,
    equation 7, as its `create_fused_ply.py` does.
    """
    before = gaussians.log_scales.double()
    after = torch.logaddexp(2 * before, 2 * filter_3d.double().abs().log()[:, None]) / 2
    opacity = gaussians.opacity_logits.double().sigmoid() * (before - after).sum(1).exp()
    return replace(gaussians, log_scales=after.float(), opacity_logits=opacity.logit().float())


def warn_antialiased(path: Path) -> None:
    """Say that a file's Gaussians are meant for the other way to draw."""
    warnings.warn(
        f"{path}: its Gaussians were trained to be drawn anti-aliased; drawn otherwise, what is small looks too heavy. "
        'Draw them with vdgs.ops.rasterization and rasterize_mode="antialiased". ExportScene(antialiased=True) '
        "writes this into a PLY or SPZ.",
        stacklevel=2,
    )


def finite_pieces(path: Path, pieces: Iterator[Gaussians]) -> Iterator[Gaussians]:
    """Pieces of a file without Gaussians that nobody can draw, counted in a warning. Infinite opacities, which say 0
    or 1, and sizes of zero become finite."""
    dropped = 0
    for piece in pieces:
        logits = piece.opacity_logits.clamp(-LARGEST_LOGIT, LARGEST_LOGIT)
        logits = torch.where(piece.opacity_logits.isinf(), logits, piece.opacity_logits)
        flat = piece.log_scales == -torch.inf
        held = replace(piece, opacity_logits=logits, log_scales=piece.log_scales.masked_fill(flat, SMALLEST_LOG_SCALE))
        good = (held.quaternions != 0).any(1)
        for tensor in held.tensors().values():
            good &= tensor.reshape(len(held), -1).isfinite().all(1) if tensor.numel() else True
        dropped += len(held) - int(good.sum())
        yield held if bool(good.all()) else held.select(good)
    if dropped:
        warnings.warn(
            f"{path}: {dropped} Gaussians have numbers that are not finite, or no rotation, and were left out.",
            stacklevel=2,
        )
