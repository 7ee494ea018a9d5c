"""Own CUDA kernels: compiled when first used, by NVRTC, for the card at hand (docs/cuda.md).

Not all operations of `vdgs.kernels` are here: `vdgs.kernels.gpu` adds what a card needs besides.
"""

from vdgs.kernels.cuda.adam import adam_tensors as adam_tensors
from vdgs.kernels.cuda.cull import cull as cull
from vdgs.kernels.cuda.decode import decode as decode
from vdgs.kernels.cuda.decode import decode_for_training as decode_for_training
from vdgs.kernels.cuda.decode_adam import decode_backward_adam as decode_backward_adam
from vdgs.kernels.cuda.loss import photometric_loss as photometric_loss
from vdgs.kernels.cuda.loss import photometric_loss_vjp as photometric_loss_vjp
from vdgs.kernels.cuda.rasterize import rasterize as rasterize
from vdgs.kernels.cuda.rasterize import rasterize_vjp as rasterize_vjp
from vdgs.kernels.cuda.rasterize import splat_contributions as splat_contributions
from vdgs.kernels.cuda.statistics import add_view_statistics as add_view_statistics
from vdgs.kernels.cuda.visibility import count_visibility as count_visibility
from vdgs.kernels.cuda.visibility import mark_visible as mark_visible
