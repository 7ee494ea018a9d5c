"""Which pixels splats reach."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from vdgs.kernels.constants import ALPHA_MIN
from vdgs.kernels.types import Splats


@torch.no_grad()
def reach_px(splats: Splats) -> Int32[Tensor, "m 2"]:
    """`reach` in whole pixels, rounded up; what is larger than any picture is cut."""
    return reach(splats).clamp(max=2.0**20).to(torch.int32)


@torch.no_grad()
def reach(splats: Splats) -> Float[Tensor, "m 2"]:
    """How far from its centre, in x and y, a splat's alpha is at least 1/255; 0 for one that is not to be drawn.

    Those are the splats of which a number is not finite, or whose conic is not positive definite. On the ellipse
    a dx² + 2 b dx dy + c dy² = q, dx² reaches q c / (a c - b²).
    """
    opacities = splats.opacities
    rows = torch.cat(
        [splats.means_px, splats.conics, splats.colours, opacities[:, None], splats.depths[:, None]], dim=1
    )
    a, b, c = splats.conics.unbind(dim=1)
    # In double the products are exact: of a splat seen edge-on little else is left.
    determinant = a.double() * c - b.double() * b
    drawn = rows.isfinite().all(dim=1) & (a > 0) & (c > 0) & (determinant > 0) & (opacities >= ALPHA_MIN)
    level = 2 * torch.log(opacities.clamp(min=ALPHA_MIN) / ALPHA_MIN)
    squares = torch.stack([c, a], dim=1) * (level / determinant).to(level.dtype)[:, None]
    # A pixel more for what rounding makes of the other numbers.
    far = torch.ceil(torch.sqrt(squares)) + 1
    return torch.where(drawn[:, None], far, torch.zeros_like(far))


@torch.no_grad()
def box_reached(splats: Splats, width: int, height: int) -> tuple[int, int, int, int] | None:
    """Left, top, right, bottom of the pixels of a picture that splats may reach, [left, right); None if they reach
    none. Asks for numbers: a card is waited for."""
    far, size = reach(splats), splats.means_px.new_tensor([width, height])
    low, high = splats.means_px - far, splats.means_px + far
    inside = ((far > 0) & (high > 0) & (low < size)).all(dim=1)
    if not inside.any():
        return None
    first = low[inside].amin(dim=0).floor().clamp(min=0)
    last = torch.minimum(high[inside].amax(dim=0).ceil(), size)
    (left, top), (right, bottom) = first.int().tolist(), last.int().tolist()
    return left, top, right, bottom
