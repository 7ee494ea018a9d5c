"""Readable torch implementations: the oracle of the tests, and what the C++ means."""

from vdgs.kernels.reference.adam import adam_rows as adam_rows
from vdgs.kernels.reference.cells import cell_centres as cell_centres
from vdgs.kernels.reference.cells import cell_keys as cell_keys
from vdgs.kernels.reference.cells import contains as contains
from vdgs.kernels.reference.cells import group_cells as group_cells
from vdgs.kernels.reference.cells import group_max as group_max
from vdgs.kernels.reference.cells import morton_order as morton_order
from vdgs.kernels.reference.cull import cull as cull
from vdgs.kernels.reference.decode import decode as decode
from vdgs.kernels.reference.decode import decode_to_train as decode_to_train
from vdgs.kernels.reference.decode_adam import decode_backward_adam as decode_backward_adam
from vdgs.kernels.reference.ellipsoids import mean_ellipsoids as mean_ellipsoids
from vdgs.kernels.reference.harmonics import fit_harmonics as fit_harmonics
from vdgs.kernels.reference.harmonics import harmonic_colours as harmonic_colours
from vdgs.kernels.reference.loss import photometric_loss as photometric_loss
from vdgs.kernels.reference.project import project as project
from vdgs.kernels.reference.rasterise import rasterise as rasterise
from vdgs.kernels.reference.rasterise import rasterise_vjp as rasterise_vjp
from vdgs.kernels.reference.shares import shares as shares
from vdgs.kernels.reference.statistics import add_view_statistics as add_view_statistics
from vdgs.kernels.reference.visibility import count_visibility as count_visibility
from vdgs.kernels.reference.visibility import mark_visible as mark_visible
