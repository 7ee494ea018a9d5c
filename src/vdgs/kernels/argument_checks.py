"""What the kernels of CPU and GPU ask of the shapes of their arguments: they do not look again."""

from __future__ import annotations

from torch import Tensor

from vdgs.kernels.kernel_types import FEATURE_SIZE, SplatGradients


def check_row_shapes(rows: int, **arguments: tuple[Tensor, *tuple[int, ...]]) -> None:
    """Raise ValueError unless every named tensor is [rows, its sides]."""
    for name, (tensor, *sides) in arguments.items():
        if tuple(tensor.shape) != (rows, *sides):
            raise ValueError(f"{name} must be {[rows, *sides]}, not {list(tensor.shape)}")


def check_anchor_shapes(positions: Tensor, features: Tensor, offsets: Tensor, log_scales: Tensor) -> None:
    """Raise ValueError where the tensors of anchors do not belong together."""
    check_row_shapes(
        positions.shape[0],
        positions=(positions, 3),
        features=(features, FEATURE_SIZE),
        offsets=(offsets, offsets.shape[1], 3),
        log_scales=(log_scales, 6),
    )


def check_offset_count(anchors: int, k: int) -> None:
    """Raise ValueError where so many visible anchors of k offsets are more than splats can be numbered."""
    if anchors * k >= 2**31:
        raise ValueError(f"at most 2^31 - 1 offsets can be decoded at once, not those of {anchors} anchors, {k} each")


def check_splat_gradients(g: SplatGradients) -> None:
    """Raise ValueError unless there is a row for each splat."""
    check_row_shapes(
        len(g.source),
        means_px=(g.means_px, 2), conics=(g.conics, 3), colors=(g.colors, 3), opacities=(g.opacities,),
        color_values=(g.color_values, 3), opacity_values=(g.opacity_values,),
        **({} if g.depths is None else {"depths": (g.depths,)}),
    )  # fmt: skip
