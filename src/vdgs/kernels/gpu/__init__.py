"""What a GPU computes with: torch, own CUDA kernels and gsplat, put together to the whole set of operations.

`vdgs.kernels.operations.GPU_BACKENDS` says which operation is which.
"""

from vdgs.kernels.cuda import adam_tensors as adam_tensors
from vdgs.kernels.cuda import add_view_statistics as add_view_statistics
from vdgs.kernels.cuda import count_visibility as count_visibility
from vdgs.kernels.cuda import cull as cull
from vdgs.kernels.cuda import decode as decode
from vdgs.kernels.cuda import decode_backward_adam as decode_backward_adam
from vdgs.kernels.cuda import decode_for_training as decode_for_training
from vdgs.kernels.cuda import mark_visible as mark_visible
from vdgs.kernels.cuda import photometric_loss as photometric_loss
from vdgs.kernels.cuda import photometric_loss_vjp as photometric_loss_vjp
from vdgs.kernels.cuda import splat_contributions as splat_contributions
from vdgs.kernels.gpu.rasterizer import rasterize as rasterize
from vdgs.kernels.gpu.rasterizer import rasterize_vjp as rasterize_vjp
from vdgs.kernels.torch_ref import adam_rows as adam_rows
from vdgs.kernels.torch_ref import cell_centers as cell_centers
from vdgs.kernels.torch_ref import cell_keys as cell_keys
from vdgs.kernels.torch_ref import contains as contains
from vdgs.kernels.torch_ref import fade_factors as fade_factors
from vdgs.kernels.torch_ref import fit_harmonics as fit_harmonics
from vdgs.kernels.torch_ref import group_cells as group_cells
from vdgs.kernels.torch_ref import group_max as group_max
from vdgs.kernels.torch_ref import harmonic_colors as harmonic_colors
from vdgs.kernels.torch_ref import mean_ellipsoids as mean_ellipsoids
from vdgs.kernels.torch_ref import merged_splats as merged_splats
from vdgs.kernels.torch_ref import morton_order as morton_order
from vdgs.kernels.torch_ref import project as project
