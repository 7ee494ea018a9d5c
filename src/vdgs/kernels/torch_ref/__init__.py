"""Readable torch implementations: the oracle of the tests, and what the C++ means."""

from vdgs.kernels.torch_ref.adam import adam_rows as adam_rows
from vdgs.kernels.torch_ref.adam import adam_tensors as adam_tensors
from vdgs.kernels.torch_ref.cells import cell_centers as cell_centers
from vdgs.kernels.torch_ref.cells import cell_keys as cell_keys
from vdgs.kernels.torch_ref.cells import contains as contains
from vdgs.kernels.torch_ref.cells import group_cells as group_cells
from vdgs.kernels.torch_ref.cells import group_max as group_max
from vdgs.kernels.torch_ref.cells import morton_order as morton_order
from vdgs.kernels.torch_ref.cull import cull as cull
from vdgs.kernels.torch_ref.decode import decode as decode
from vdgs.kernels.torch_ref.decode import decode_for_training as decode_for_training
from vdgs.kernels.torch_ref.decode_adam import decode_backward_adam as decode_backward_adam
from vdgs.kernels.torch_ref.ellipsoids import mean_ellipsoids as mean_ellipsoids
from vdgs.kernels.torch_ref.harmonics import fit_harmonics as fit_harmonics
from vdgs.kernels.torch_ref.harmonics import harmonic_colors as harmonic_colors
from vdgs.kernels.torch_ref.loss import photometric_loss as photometric_loss
from vdgs.kernels.torch_ref.loss import photometric_loss_vjp as photometric_loss_vjp
from vdgs.kernels.torch_ref.merged_splats import merged_splats as merged_splats
from vdgs.kernels.torch_ref.project import project as project
from vdgs.kernels.torch_ref.rasterize import rasterize as rasterize
from vdgs.kernels.torch_ref.rasterize import rasterize_vjp as rasterize_vjp
from vdgs.kernels.torch_ref.rasterize import splat_contributions as splat_contributions
from vdgs.kernels.torch_ref.statistics import add_view_statistics as add_view_statistics
from vdgs.kernels.torch_ref.visibility import count_visibility as count_visibility
from vdgs.kernels.torch_ref.visibility import fade_factors as fade_factors
from vdgs.kernels.torch_ref.visibility import mark_visible as mark_visible
