"""Growth's statistics of one view, as index arithmetic in torch."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vdgs.kernels.argument_checks import check_row_shapes
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.kernels.splat_segments import SplatMask, sources_tensor
from vdgs.kernels.transfer import is_host


def add_view_statistics(
    statistics: DensificationStats,
    visible: Int64[Tensor, "v"],
    inside: Bool[Tensor, "v"],
    source: Int32[Tensor, "m"] | SplatMask,
    opacities: Float[Tensor, "m"],
    gradient_px: Float[Tensor, "m 2"],
    width: int,
    height: int,
) -> None:
    """Add one view to the sums that growth decides by (Scaffold-GS section 4.2), in place.

    `source` is (index in `visible`) k + offset, ascending without repetition; `gradient_px` is the gradient by the
    means in pixels, whose norm is taken in NDC ([-1, 1] across the image, hence width/2 and height/2). Each drawn
    offset gains its norm and a count, each visible anchor the opacity of its splats, and a count if its center is
    `inside` the image. Raises IndexError for a source beyond the visible anchors, ValueError for an unsuitable
    `inside` or other shapes that do not match, before any change.
    """
    k = statistics.gradient.shape[1]
    sources = sources_tensor(source)
    check_sources(sources, visible, k)
    check_inside(inside, visible)
    check_sums_and_splats(statistics, len(sources), opacities, gradient_px)
    row = sources.long()
    slot = visible[row // k] * k + row % k
    norm = torch.hypot(gradient_px[:, 0] * (width / 2), gradient_px[:, 1] * (height / 2))
    statistics.gradient.view(-1)[slot] += norm
    statistics.drawn.view(-1)[slot] += 1
    statistics.opacity[visible] += opacities.new_zeros(len(visible)).index_add_(0, row // k, opacities)
    statistics.seen[visible] += inside.float()


def check_sources(source: Tensor, visible: Tensor, k: int) -> None:
    """Raise IndexError unless the ascending sources belong to the visible anchors."""
    if is_host(source) and len(source) and not (int(source[0]) >= 0 and int(source[-1]) < len(visible) * k):
        raise IndexError(f"a source lies outside the {len(visible)} visible anchors of {k} offsets")


def check_inside(inside: Tensor, visible: Tensor) -> None:
    """Raise ValueError unless this is a mask of the visible anchors."""
    if inside.dtype != torch.bool or inside.shape != visible.shape:
        raise ValueError(f"inside must be bool {list(visible.shape)}, not {inside.dtype} {list(inside.shape)}")


def check_sums_and_splats(statistics: DensificationStats, splats: int, opacities: Tensor, gradient_px: Tensor) -> None:
    """Raise ValueError unless the sums are of the same anchors, and so many splats have an opacity and a gradient."""
    n, k = statistics.gradient.shape
    check_row_shapes(n, drawn=(statistics.drawn, k), opacity=(statistics.opacity,), seen=(statistics.seen,))
    check_row_shapes(splats, opacities=(opacities,), gradient_px=(gradient_px, 2))
