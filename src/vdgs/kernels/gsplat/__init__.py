"""The rasteriser of gsplat (Apache-2.0, the extra `gsplat`) behind `vdgs.kernels`' own operations, on a GPU.

Many cards have run it, and none the own kernels so far: where it is installed, it draws and differentiates the pictures
of training (`vdgs.kernels.gpu`). It follows gsplat 1.5.3 (docs/cuda.md).
"""

from vdgs.kernels.gsplat.rasterize import rasterize as rasterize
from vdgs.kernels.gsplat.rasterize import rasterize_vjp as rasterize_vjp
