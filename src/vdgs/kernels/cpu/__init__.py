"""C++ implementations for the CPU, chosen at run time by instruction set."""

from vdgs.kernels.cpu.adam import adam_rows as adam_rows
from vdgs.kernels.cpu.adam import adam_tensors as adam_tensors
from vdgs.kernels.cpu.cells import cell_centers as cell_centers
from vdgs.kernels.cpu.cells import cell_keys as cell_keys
from vdgs.kernels.cpu.cells import contains as contains
from vdgs.kernels.cpu.cells import group_cells as group_cells
from vdgs.kernels.cpu.cells import group_max as group_max
from vdgs.kernels.cpu.cells import morton_order as morton_order
from vdgs.kernels.cpu.cull import cull as cull
from vdgs.kernels.cpu.decode import decode as decode
from vdgs.kernels.cpu.decode import decode_for_training as decode_for_training
from vdgs.kernels.cpu.decode_adam import decode_backward_adam as decode_backward_adam
from vdgs.kernels.cpu.ellipsoids import mean_ellipsoids as mean_ellipsoids
from vdgs.kernels.cpu.harmonics import fit_harmonics as fit_harmonics
from vdgs.kernels.cpu.harmonics import harmonic_colors as harmonic_colors
from vdgs.kernels.cpu.loss import photometric_loss as photometric_loss
from vdgs.kernels.cpu.loss import photometric_loss_vjp as photometric_loss_vjp
from vdgs.kernels.cpu.merged_splats import merged_splats as merged_splats
from vdgs.kernels.cpu.project import project as project
from vdgs.kernels.cpu.rasterize import rasterize as rasterize
from vdgs.kernels.cpu.rasterize import rasterize_vjp as rasterize_vjp
from vdgs.kernels.cpu.rasterize import splat_contributions as splat_contributions
from vdgs.kernels.cpu.statistics import add_view_statistics as add_view_statistics
from vdgs.kernels.cpu.visibility import count_visibility as count_visibility
from vdgs.kernels.cpu.visibility import fade_factors as fade_factors
from vdgs.kernels.cpu.visibility import mark_visible as mark_visible
