"""gsplat 1.5.3's three functions as documented, in torch: shapes are checked as it checks them, tiles are kept to.

A splat is drawn only in tiles that its radii reach, so that radii that are too small show in the picture.
"""

from __future__ import annotations

import torch
from torch import Tensor


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Tiles of each Gaussian [1, N], ids (tile << 32 | depth) and indices of Gaussians, sorted by id."""
    (images, n, two), dtype = means2d.shape, radii.dtype
    assert (images, two, dtype) == (1, 2, torch.int32)
    assert radii.shape == (1, n, 2)
    assert depths.shape == (1, n)
    assert not means2d.requires_grad
    counts = torch.zeros(1, n, dtype=torch.int32)
    found = []
    for i in range(n):
        if (radii[0, i] <= 0).any():
            continue
        centre, reach = means2d[0, i] / tile_size, radii[0, i] / tile_size
        low, high = torch.floor(centre - reach).long(), torch.ceil(centre + reach).long()
        for row in range(max(0, int(low[1])), min(tile_height, int(high[1]))):
            for column in range(max(0, int(low[0])), min(tile_width, int(high[0]))):
                bits = int(depths[0, i].view(torch.int32))
                found.append(((row * tile_width + column) << 32 | bits, i))
                counts[0, i] += 1
    found.sort(key=lambda pair: pair[0])  # stable, as gsplat's radix sort
    ids = torch.tensor([key for key, _ in found], dtype=torch.int64)
    return counts, ids, torch.tensor([i for _, i in found], dtype=torch.int32)


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Where each tile begins among the ids, [I, tile_height, tile_width]."""
    assert n_images == 1
    tiles = torch.arange(tile_width * tile_height)
    return torch.searchsorted(isect_ids >> 32, tiles).to(torch.int32).reshape(1, tile_height, tile_width)


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, image_width: int, image_height: int,
    tile_size: int, isect_offsets: Tensor, flatten_ids: Tensor, backgrounds: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Colours [1, h, w, channels] and alphas [1, h, w, 1], differentiable."""
    (_, n, _), channels = means2d.shape, colors.shape[-1]
    assert conics.shape == (1, n, 3)
    assert colors.shape == (1, n, channels)
    assert opacities.shape == (1, n)
    assert backgrounds is not None
    assert backgrounds.shape == (1, channels)
    assert isect_offsets.ndim == 3
    rows, columns = isect_offsets.shape[-2:]
    assert rows * tile_size >= image_height
    assert columns * tile_size >= image_width
    ends = torch.cat([isect_offsets.reshape(-1)[1:], torch.tensor([len(flatten_ids)])])
    tiles = []
    for tile, (begin, end) in enumerate(zip(isect_offsets.reshape(-1), ends, strict=True)):
        chosen = flatten_ids[int(begin) : int(end)].long()
        origin = torch.tensor([tile % columns, tile // columns]) * tile_size
        own = [tensor[0, chosen] for tensor in (means2d, conics, colors, opacities)]
        tiles.append(_tile(*own, backgrounds[0], origin, tile_size))
    whole = torch.stack(tiles).reshape(rows, columns, tile_size, tile_size, channels + 1)
    picture = whole.permute(0, 2, 1, 3, 4).reshape(rows * tile_size, columns * tile_size, channels + 1)
    picture = picture[None, :image_height, :image_width]
    return picture[..., :channels], picture[..., channels:]


def _tile(
    means: Tensor, conics: Tensor, colours: Tensor, opacities: Tensor, background: Tensor, origin: Tensor, side: int
) -> Tensor:
    """Colours and alpha of a tile, [side, side, channels + 1]."""
    through = torch.ones(side, side)
    painted = torch.zeros(side, side, colours.shape[1])
    open_ = torch.ones(side, side, dtype=torch.bool)
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    pixels = torch.stack([x, y], dim=-1) + origin + 0.5
    for mean, (a, b, c), colour, opacity in zip(means, conics, colours, opacities, strict=True):
        dx, dy = (mean - pixels).unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacity * torch.exp(-sigma)).clamp(max=0.999)
        alpha = torch.where((sigma < 0) | (alpha < 1 / 255), torch.zeros_like(alpha), alpha)
        ends = through * (1 - alpha) <= 1e-4
        open_ = open_ & ~(ends & (alpha > 0))
        alpha = alpha * open_
        painted = painted + (alpha * through)[..., None] * colour
        through = through * (1 - alpha)
    painted = painted + through[..., None] * background
    return torch.cat([painted, 1 - through[..., None]], dim=-1)
