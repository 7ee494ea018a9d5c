"""Which rasterizer draws on a GPU: the own kernels, or gsplat where it is asked for. The own kernels draw depth in any
case, since gsplat cannot tell the median depth of a pixel."""

from __future__ import annotations

import os
from functools import cache
from types import ModuleType

from jaxtyping import Float
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.kernels import cuda, gsplat
from vdgs.kernels.gsplat import load_gsplat
from vdgs.kernels.kernel_types import Raster, RasterPullback, Splats

#: Environment variable that takes one of them: `gsplat` or `cuda`.
RASTERIZER_ENV_VAR = "VDGS_RASTERIZER"


def rasterize(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False
) -> Raster:
    """As `cpu.rasterize`, for float32 tensors on a GPU."""
    return _drawing(depth).rasterize(splats, background, width, height, depth=depth)


def rasterize_vjp(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False
) -> tuple[Raster, RasterPullback]:
    """`rasterize` without autograd: the picture, and the way back from it, which may read the splats again."""
    return _drawing(depth).rasterize_vjp(splats, background, width, height, depth=depth)


def _drawing(depth: bool) -> ModuleType:
    return cuda if depth else select_rasterizer(os.environ.get(RASTERIZER_ENV_VAR, ""))


@cache
def select_rasterizer(name: str) -> ModuleType:
    """The implementation of this name, of "" the own kernels. Raises GsplatUnavailable where gsplat cannot be
    used, VdgsError for another word."""
    if name not in ("", "gsplat", "cuda"):
        raise VdgsError(f"{RASTERIZER_ENV_VAR} must be gsplat, cuda or not set, not {name!r}.")
    if name != "gsplat":
        return cuda
    load_gsplat()
    return gsplat
