"""CUDA implementations: compiled when first used, by NVRTC, for the card at hand (docs/cuda.md).

Not all operations of `vdgs.kernels` are here yet: `vdgs.kernels.operations` names those that are.
"""

from vdgs.kernels.cuda.loss import photometric_loss

__all__ = ["photometric_loss"]
