"""Stands in for the compiled part of gsplat 1.5.3, on the processor: the four functions that its Python calls for tiles
and pixels, with the arguments and results of its C++ (`gsplat/cuda/_wrapper.py`, `csrc/Intersect.cpp`,
`csrc/Rasterization.cpp`).

A splat is drawn only in tiles that its radii reach, so that radii that are too small show in the picture. All the rest
of gsplat is its own.
"""

from __future__ import annotations

import importlib.util
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from support.fake_device import unseen

needs_gsplat = pytest.mark.skipif(
    importlib.util.find_spec("gsplat") is None, reason="gsplat: pip install 'vdgs[gsplat]'"
)


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put it where gsplat looks for what it has compiled."""
    functions = (intersect_tile, intersect_offset, rasterize_to_pixels_3dgs_fwd, rasterize_to_pixels_3dgs_bwd)
    compiled = SimpleNamespace(**{function.__name__: unseen(function) for function in functions})
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=compiled))  # type: ignore[arg-type]


def intersect_tile(
    means2d: Tensor, radii: Tensor, depths: Tensor, image_ids: None, gaussian_ids: None, images: int, tile_size: int,
    tile_width: int, tile_height: int, sort: bool, segmented: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Tiles of each Gaussian [1, N], ids (tile << 32 | bits of the depth) and indices of Gaussians, sorted by id."""
    assert (image_ids, gaussian_ids, images, sort, segmented) == (None, None, 1, True, False)
    assert radii.dtype == torch.int32
    assert all(tensor.is_contiguous() for tensor in (means2d, radii, depths))
    most = torch.tensor([tile_width, tile_height], dtype=torch.float32)
    center, reach = means2d[0] / tile_size, radii[0].float() / tile_size
    low = torch.minimum(torch.floor(center - reach).nan_to_num().clamp(min=0), most).long()
    high = torch.minimum(torch.ceil(center + reach).nan_to_num().clamp(min=0), most).long()
    sides = torch.where((radii[0] > 0).all(1, keepdim=True), high - low, 0)
    counts = sides.prod(1)
    owner = torch.repeat_interleave(torch.arange(len(counts)), counts)
    place = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    row, column = low[owner, 1] + place // sides[owner, 0], low[owner, 0] + place % sides[owner, 0]
    bits = depths[0].contiguous().view(torch.int32).long() & 0xFFFFFFFF
    ids, order = torch.sort((row * tile_width + column) << 32 | bits[owner], stable=True)
    return counts.to(torch.int32)[None], ids, owner[order].to(torch.int32)


def intersect_offset(isect_ids: Tensor, images: int, tile_width: int, tile_height: int) -> Tensor:
    """Where each tile begins among the ids, [I, tile_height, tile_width]."""
    assert images == 1
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).to(torch.int32).reshape(1, tile_height, tile_width)


def rasterize_to_pixels_3dgs_fwd(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor, masks: None, width: int,
    height: int, tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Colors [1, h, w, channels], alphas [1, h, w, 1] and, as gsplat does, the last Gaussian of each pixel."""
    assert masks is None
    with torch.no_grad():
        colors, alphas = _drawn(
            (means2d, conics, colors, opacities), backgrounds, (width, height), tile_size, isect_offsets, flatten_ids
        )
    return colors, alphas, torch.zeros(1, height, width, dtype=torch.int32)


def rasterize_to_pixels_3dgs_bwd(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, backgrounds: Tensor, masks: None, width: int,
    height: int, tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor, render_alphas: Tensor, last_ids: Tensor,
    v_render_colors: Tensor, v_render_alphas: Tensor, absgrad: bool,
) -> tuple[None, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients by means, conics, colors and opacities; the first place is that of absolute ones."""
    assert not absgrad
    assert render_alphas.shape == (*last_ids.shape, 1) == (1, height, width, 1)
    leaves = [tensor.detach().requires_grad_() for tensor in (means2d, conics, colors, opacities)]
    with torch.enable_grad():
        drawn = _drawn(leaves, backgrounds.detach(), (width, height), tile_size, isect_offsets, flatten_ids)
    found = torch.autograd.grad(drawn, leaves, (v_render_colors, v_render_alphas), materialize_grads=True)
    return None, *found


def _drawn(
    splats: Any, backgrounds: Tensor, size: tuple[int, int], side: int, isect_offsets: Tensor, flatten_ids: Tensor
) -> tuple[Tensor, Tensor]:
    (width, height), (rows, columns), channels = size, isect_offsets.shape[-2:], splats[2].shape[-1]
    bounds = [*isect_offsets.reshape(-1).tolist(), len(flatten_ids)]
    tiles = []
    for tile in range(rows * columns):
        chosen = flatten_ids[bounds[tile] : bounds[tile + 1]].long()
        origin = torch.tensor([tile % columns, tile // columns]) * side
        tiles.append(_tile(*(tensor[0, chosen] for tensor in splats), backgrounds[0], origin, side))
    whole = torch.stack(tiles).reshape(rows, columns, side, side, channels + 1)
    picture = whole.permute(0, 2, 1, 3, 4).reshape(rows * side, columns * side, channels + 1)[None, :height, :width]
    return picture[..., :channels].contiguous(), picture[..., channels:].contiguous()


def _tile(
    means: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, background: Tensor, origin: Tensor, side: int
) -> Tensor:
    """Colors and alpha of a tile, [side, side, channels + 1]."""
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    pixels = torch.stack([x, y], dim=-1) + origin + 0.5
    dx, dy = (means[:, None, None] - pixels).unbind(-1)
    a, b, c = (conics[:, i, None, None] for i in range(3))
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[:, None, None] * torch.exp(-sigma)).clamp(max=0.999)
    alpha = torch.where((sigma < 0) | (alpha < 1 / 255), torch.zeros_like(alpha), alpha)
    with torch.no_grad():
        stopped = torch.cumprod(1 - alpha, dim=0) <= 1e-4
    alpha = alpha.masked_fill(stopped, 0.0)
    before = torch.cat([torch.ones(1, side, side), torch.cumprod(1 - alpha, dim=0)])
    through = before[-1][..., None]
    painted = torch.einsum("nhw,nc->hwc", alpha * before[:-1], colors) + through * background
    return torch.cat([painted, 1 - through], dim=-1)
