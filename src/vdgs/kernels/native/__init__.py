"""C++ implementations for the CPU, chosen at run time by instruction set."""

from vdgs.kernels.native.adam import adam_rows as adam_rows
from vdgs.kernels.native.cells import cell_centres as cell_centres
from vdgs.kernels.native.cells import cell_keys as cell_keys
from vdgs.kernels.native.cells import contains as contains
from vdgs.kernels.native.cells import group_cells as group_cells
from vdgs.kernels.native.cells import group_max as group_max
from vdgs.kernels.native.cells import morton_order as morton_order
from vdgs.kernels.native.cull import cull as cull
from vdgs.kernels.native.decode import decode as decode
from vdgs.kernels.native.decode import decode_to_train as decode_to_train
from vdgs.kernels.native.decode_adam import decode_backward_adam as decode_backward_adam
from vdgs.kernels.native.ellipsoids import mean_ellipsoids as mean_ellipsoids
from vdgs.kernels.native.harmonics import fit_harmonics as fit_harmonics
from vdgs.kernels.native.harmonics import harmonic_colours as harmonic_colours
from vdgs.kernels.native.loss import photometric_loss as photometric_loss
from vdgs.kernels.native.project import project as project
from vdgs.kernels.native.rasterise import rasterise as rasterise
from vdgs.kernels.native.rasterise import rasterise_vjp as rasterise_vjp
from vdgs.kernels.native.rasterise import shares as shares
from vdgs.kernels.native.statistics import add_view_statistics as add_view_statistics
from vdgs.kernels.native.visibility import count_visibility as count_visibility
from vdgs.kernels.native.visibility import mark_visible as mark_visible
