"""The rasteriser of gsplat (Apache-2.0, the extra `gsplat`) behind `vdgs.kernels`' own operation, on a GPU.

It is not what training uses. It is a second opinion: an implementation by others, to compare the own ones with. It was
written to gsplat 1.5.3's documented interface and has not been run on a GPU (docs/cuda.md).
"""

from vdgs.kernels.gsplat.rasterise import rasterise

__all__ = ["rasterise"]
