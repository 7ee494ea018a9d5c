"""The rasterizer of gsplat 1.5.3 (Apache-2.0, the extra `gsplat`) behind the operations of `vdgs.kernels`, on a GPU.

It calls `isect_tiles`, `isect_offset_encode` and `rasterize_to_pixels`; `vdgs.kernels.gpu` uses it where it is
installed (docs/cuda.md). Both sides agree on means (the first pixel's center is (0.5, 0.5)), conics, alpha (1/255 to
0.999), the end of a pixel (transmittance 1e-4) and equal depths (the order of the rows: `OrderedSplats.segments` is
ignored). gsplat needs the extent of each splat, and has no depth: here depth is a fourth color over a background of
zero. It cannot compute the median depth, which is None.
"""

from __future__ import annotations

import importlib
import sys
from contextlib import redirect_stdout
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from vdgs.errors import VdgsError
from vdgs.kernels.autograd import check_splats, vjp_from_autograd
from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.kernel_types import Raster, RasterPullback, Splats

#: Side of gsplat's tiles, in pixels (its default).
TILE_PX = 16


class GsplatUnavailable(VdgsError):
    """gsplat is not installed or does not load."""


def rasterize(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False, engine: Any = None
) -> Raster:
    """As `cpu.rasterize`, for tensors on a GPU; depths must be positive (gsplat sorts by their bits).

    Waits for the device once, in `isect_tiles`: for how many tiles the splats reach. `engine` offers gsplat's three
    functions (default: gsplat, which compiles its kernels when first used; that takes minutes and a CUDA toolkit).
    Raises GsplatUnavailable without gsplat, TypeError or ValueError for unsuitable tensors.
    """
    engine = engine or load_gsplat()
    check_splats((*splats.tensors, background), width, height)
    means_px, conics, colors, opacities, depths = splats.tensors
    if not len(means_px):
        return _empty(background, width, height, depth)
    reach = splat_radii_px(splats)
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    # gsplat draws several pictures at once: this is one.
    means, radii, near = means_px[None], reach[None], depths[None]
    _, keys, order = engine.isect_tiles(means.detach(), radii, near.detach(), TILE_PX, columns, rows)
    offsets = engine.isect_offset_encode(keys, 1, columns, rows).reshape(1, rows, columns)
    painted, behind = colors, background
    if depth:
        painted, behind = torch.cat([colors, depths[:, None]], dim=1), torch.cat([background, background.new_zeros(1)])
    picture, alpha = engine.rasterize_to_pixels(
        means, conics[None], painted[None], opacities[None], width, height, TILE_PX, offsets, order,
        backgrounds=behind[None],
    )  # fmt: skip
    return Raster(picture[0, ..., :3], alpha[0, ..., 0], picture[0, ..., 3] if depth else None)


def rasterize_vjp(
    splats: Splats, background: Float[Tensor, "3"], width: int, height: int, *, depth: bool = False, engine: Any = None
) -> tuple[Raster, RasterPullback]:
    """`rasterize`, and the way back from it: gsplat's own derivative, those of the means in pixels among it."""

    def draw(splats: Splats, background: Tensor) -> Raster:
        return rasterize(splats, background, width, height, depth=depth, engine=engine)

    return vjp_from_autograd(draw, splats, background)


@torch.no_grad()
def splat_radii_px(splats: Splats) -> Int32[Tensor, "m 2"]:
    """How far from its center, in x and y, a splat's alpha is at least 1/255; 0 for one that is not to be drawn.

    Those are the splats of which a number is not finite, or whose conic is not positive definite. On the ellipse
    a dx² + 2 b dx dy + c dy² = q, dx² reaches q c / (a c - b²).
    """
    opacities = splats.opacities
    rows = torch.cat([splats.means_px, splats.conics, splats.colors, opacities[:, None], splats.depths[:, None]], dim=1)
    a, b, c = splats.conics.unbind(dim=1)
    determinant = a * c - b * b
    drawn = rows.isfinite().all(dim=1) & (a > 0) & (c > 0) & (determinant > 0) & (opacities >= ALPHA_MIN)
    level = 2 * torch.log(opacities.clamp(min=ALPHA_MIN) / ALPHA_MIN)
    squares = torch.stack([c, a], dim=1) * (level / determinant)[:, None]
    # Rounded up, and a pixel for what rounding makes of the other numbers; what is larger covers every picture.
    reach = torch.ceil(torch.sqrt(squares)).clamp(max=2.0**20) + 1
    return torch.where(drawn[:, None], reach, torch.zeros_like(reach)).to(torch.int32)


def load_gsplat() -> Any:
    """gsplat, as installed, its kernels compiled. Raises GsplatUnavailable, with what to do, if it cannot be used."""
    try:
        engine = importlib.import_module("gsplat")
        with redirect_stdout(sys.stderr):  # it tells the terminal how compiling goes; output belongs to the verbs
            backend = importlib.import_module("gsplat.cuda._backend")
    except Exception as error:  # its import may also fail for want of a compiler or of a fitting torch
        raise GsplatUnavailable(
            f"gsplat cannot be used ({type(error).__name__}: {error}). Install it: pip install 'vdgs[gsplat]'. It "
            "needs an NVIDIA GPU, and a CUDA toolkit to compile its kernels."
        ) from error
    if backend._C is None:  # it prints a line and goes on
        raise GsplatUnavailable("gsplat has no kernels: it found no CUDA toolkit (nvcc) to compile them.")
    return engine


def _empty(background: Tensor, width: int, height: int, depth: bool) -> Raster:
    """A picture of nothing; the background still has its gradient."""
    nothing = background.new_zeros(height, width)
    return Raster(background.expand(height, width, 3).clone(), nothing, nothing.clone() if depth else None)
