"""C++ implementations for the CPU, chosen at run time by instruction set."""

from vdgs.kernels.native.adam import adam_rows
from vdgs.kernels.native.cells import cell_centres, cell_keys, contains, group_cells, group_max, morton_order
from vdgs.kernels.native.cull import cull
from vdgs.kernels.native.decode import decode, decode_to_train
from vdgs.kernels.native.decode_adam import decode_backward_adam
from vdgs.kernels.native.ellipsoids import mean_ellipsoids
from vdgs.kernels.native.harmonics import fit_harmonics, harmonic_colours
from vdgs.kernels.native.loss import photometric_loss
from vdgs.kernels.native.project import project
from vdgs.kernels.native.rasterise import rasterise, rasterise_vjp, shares
from vdgs.kernels.native.statistics import add_view_statistics
from vdgs.kernels.native.visibility import count_visibility, mark_visible

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
