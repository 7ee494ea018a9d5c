"""What a GPU computes with: torch, own CUDA kernels and gsplat, put together to the whole set of operations.

`vdgs.kernels.operations.ON_A_CARD` says which operation is which.
"""

from vdgs.kernels.composed.rasteriser import rasterise, rasterise_vjp
from vdgs.kernels.cuda import (
    add_view_statistics,
    cull,
    decode,
    decode_backward_adam,
    decode_to_train,
    photometric_loss,
    shares,
)
from vdgs.kernels.reference import (
    adam_rows,
    cell_centres,
    cell_keys,
    contains,
    count_visibility,
    fit_harmonics,
    group_cells,
    group_max,
    harmonic_colours,
    mark_visible,
    mean_ellipsoids,
    morton_order,
    project,
)

__all__ = [
    "adam_rows",
    "add_view_statistics",
    "cell_centres",
    "cell_keys",
    "contains",
    "count_visibility",
    "cull",
    "decode",
    "decode_backward_adam",
    "decode_to_train",
    "fit_harmonics",
    "group_cells",
    "group_max",
    "harmonic_colours",
    "mark_visible",
    "mean_ellipsoids",
    "morton_order",
    "photometric_loss",
    "project",
    "rasterise",
    "rasterise_vjp",
    "shares",
]
