"""Own CUDA kernels: compiled when first used, by NVRTC, for the card at hand (docs/cuda.md).

Not all operations of `vdgs.kernels` are here: `vdgs.kernels.composed` adds what a card needs besides.
"""

from vdgs.kernels.cuda.cull import cull
from vdgs.kernels.cuda.decode import decode, decode_to_train
from vdgs.kernels.cuda.decode_adam import decode_backward_adam
from vdgs.kernels.cuda.loss import photometric_loss
from vdgs.kernels.cuda.rasterise import rasterise, rasterise_vjp, shares
from vdgs.kernels.cuda.statistics import add_view_statistics

__all__ = [
    "add_view_statistics",
    "cull",
    "decode",
    "decode_backward_adam",
    "decode_to_train",
    "photometric_loss",
    "rasterise",
    "rasterise_vjp",
    "shares",
]
