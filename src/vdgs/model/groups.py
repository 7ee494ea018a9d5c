"""Places in groups of neighbours, so that a camera looks at those about its frustum and not at all there are."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from vdgs.cameras import NEAR, Camera
from vdgs.kernels import choose

#: Places in a group.
GROUP = 256
#: What rounding in float32 may add to distances, as a share of the lengths that they are computed from.
ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class Groups:
    """Places along a Morton curve in groups of `GROUP`, and the ball that holds each group (float64)."""

    order: Int64[Tensor, " n"]
    centres: Float[Tensor, "g 3"]
    radii: Float[Tensor, " g"]

    @staticmethod
    def of(positions: Float[Tensor, "n 3"]) -> Groups:
        """O(n)."""
        known = torch.nan_to_num(positions.detach(), nan=0.0, posinf=0.0, neginf=0.0)
        order = choose(positions.device).morton_order(known)
        missing = -len(order) % GROUP
        filled = torch.cat([order, order[-1:].expand(missing)]) if missing else order
        grouped = known[filled].double().reshape(-1, GROUP, 3)
        low, high = grouped.amin(dim=1), grouped.amax(dim=1)
        return Groups(order, (low + high) / 2, (high - low).norm(dim=1) / 2)

    def about(self, camera: Camera) -> Int64[Tensor, " some"]:
        """The places, ascending, that may fall into the picture of a pinhole camera: all that do, and few others.

        O(n / GROUP + what it returns).
        """
        rigid = torch.as_tensor(camera.camera_from_world).to(self.centres)
        local = self.centres @ rigid[:3, :3].T + rigid[:3, 3]
        x, y, z = local.T
        reach = self.radii + ROUNDING * (self.radii + self.centres.norm(dim=1) + rigid[:3, 3].norm())
        held = z + reach > NEAR
        for focal, side, along in (
            (camera.fx, camera.cx, x), (-camera.fx, camera.width - camera.cx, x),
            (camera.fy, camera.cy, y), (-camera.fy, camera.height - camera.cy, y),
        ):  # fmt: skip
            held &= focal * along + side * z > -reach * (focal**2 + side**2) ** 0.5
        chosen = held.nonzero()
        rows = (chosen * GROUP + torch.arange(GROUP, device=chosen.device)).reshape(-1)
        return self.order[rows[rows < len(self.order)]].sort().values
