"""Which operations there are, and which of them have a CUDA implementation. Imports nothing."""

from __future__ import annotations

#: What training, drawing and measuring call: every function of `vdgs.kernels.native`.
OPERATIONS = (
    "adam_rows", "add_view_statistics", "cell_centres", "cell_keys", "contains", "count_visibility", "cull", "decode",
    "decode_backward_adam", "group_cells", "group_max", "mark_visible", "morton_order", "photometric_loss", "project",
    "rasterise",
)  # fmt: skip

#: Those that `vdgs.kernels.cuda` has.
CUDA_OPERATIONS = ("photometric_loss",)


def missing_on_cuda() -> tuple[str, ...]:
    """The operations without a CUDA implementation."""
    return tuple(name for name in OPERATIONS if name not in CUDA_OPERATIONS)
