"""Growth's statistics of one view in C++: one pass over the splats, threaded by anchors."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from vdgs.kernels.cpu import extension
from vdgs.kernels.cpu.arguments import check_outputs
from vdgs.kernels.kernel_types import DensificationStats
from vdgs.kernels.splat_segments import SplatMask, sources_tensor
from vdgs.kernels.torch_ref.statistics import check_inside, check_sources, check_sums_and_splats


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
    """As `torch_ref.add_view_statistics`, for contiguous float32. Same bits for any number of threads."""
    gradient = statistics.gradient
    check_outputs(**statistics.tensors())
    sources = sources_tensor(source)
    check_sources(sources, visible, gradient.shape[1])
    check_inside(inside, visible)
    check_sums_and_splats(statistics, len(sources), opacities, gradient_px)
    if len(visible) and not (int(visible.min()) >= 0 and int(visible.max()) < len(gradient)):
        raise IndexError(f"a visible anchor lies outside the {len(gradient)} anchors")
    extension.get_extension().add_view_statistics(
        visible, inside.contiguous().view(torch.uint8), sources, opacities.detach().contiguous(),
        gradient_px.contiguous(), width / 2, height / 2, gradient, statistics.drawn, statistics.opacity,
        statistics.seen,
    )  # fmt: skip
