"""Readable torch implementations: the oracle of the tests, and what the C++ means."""

from vdgs.kernels.reference.adam import adam_rows
from vdgs.kernels.reference.cells import cell_centres, cell_keys, contains, group_cells, group_max, morton_order
from vdgs.kernels.reference.cull import cull
from vdgs.kernels.reference.decode import decode, decode_to_train
from vdgs.kernels.reference.decode_adam import decode_backward_adam
from vdgs.kernels.reference.ellipsoids import mean_ellipsoids
from vdgs.kernels.reference.harmonics import fit_harmonics, harmonic_colours
from vdgs.kernels.reference.loss import photometric_loss
from vdgs.kernels.reference.project import project
from vdgs.kernels.reference.rasterise import rasterise, rasterise_vjp
from vdgs.kernels.reference.shares import shares
from vdgs.kernels.reference.statistics import add_view_statistics
from vdgs.kernels.reference.visibility import count_visibility, mark_visible

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
