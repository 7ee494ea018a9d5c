"""Points in groups of neighbors, so that a query tests groups near a frustum instead of all points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.geometry.camera import NEAR_PLANE, Camera
from vdgs.kernels import get_backend
from vdgs.visibility.frustum import Frusta

#: Places in a group.
GROUP_SIZE = 256
#: What rounding in float32 may add to distances, as a share of the lengths that they are computed from.
ROUNDING = 1e-5


@dataclass(frozen=True, eq=False)
class SpatialGroups:
    """Places along a Morton curve in groups of `GROUP_SIZE`, and the ball that holds each group (float64)."""

    order: Int64[Tensor, " n"]
    centers: Float[Tensor, "g 3"]
    radii: Float[Tensor, " g"]

    @staticmethod
    def of(positions: Float[Tensor, "n 3"]) -> SpatialGroups:
        """O(n)."""
        known = torch.nan_to_num(positions.detach(), nan=0.0, posinf=0.0, neginf=0.0)
        order = get_backend(positions.device).morton_order(known)
        missing = -len(order) % GROUP_SIZE
        filled = torch.cat([order, order[-1:].expand(missing)]) if missing else order
        grouped = known[filled].double().reshape(-1, GROUP_SIZE, 3)
        low, high = grouped.amin(dim=1), grouped.amax(dim=1)
        return SpatialGroups(order, (low + high) / 2, (high - low).norm(dim=1) / 2)

    def query_frustum(self, camera: Camera) -> Int64[Tensor, " some"]:
        """The points, ascending, that may fall into the image of a pinhole camera: all that do, and few others. O(n /
        GROUP_SIZE + result)."""
        frustum = Frusta.of([camera], self.centers.device)
        chosen = _may_hold(self.centers, self.radii, frustum)[0].nonzero()
        rows = (chosen * GROUP_SIZE + torch.arange(GROUP_SIZE, device=chosen.device)).reshape(-1)
        return self.order[rows[rows < len(self.order)]].sort().values

    def visible_groups(self, frusta: Frusta) -> Iterator[tuple[Int64[Tensor, " rows"], Int64[Tensor, " some"]]]:
        """The places of each group that any camera may hold, and the numbers of such cameras: all that do, and few
        others. O(c n / GROUP)."""
        for number, rows in enumerate(self.order.split(GROUP_SIZE)):
            held = _may_hold(self.centers[number, None], self.radii[number, None], frusta)[:, 0]
            if held.any():
                yield rows, held.nonzero().squeeze(1)


def _may_hold(centers: Float[Tensor, "g 3"], radii: Float[Tensor, " g"], frusta: Frusta) -> Bool[Tensor, "c g"]:
    """Whether frusta may touch balls."""
    turn, shift = frusta.camera_from_world[:, :3, :3], frusta.camera_from_world[:, :3, 3]
    local = centers @ turn.transpose(1, 2) + shift[:, None]
    x, y, z = local.permute(2, 0, 1)
    reach = radii + ROUNDING * (radii + centers.norm(dim=1) + shift.norm(dim=1)[:, None])
    held = z + reach > NEAR_PLANE
    for focal, side, along in (
        (frusta.fx, frusta.cx, x), (-frusta.fx, frusta.width - frusta.cx, x),
        (frusta.fy, frusta.cy, y), (-frusta.fy, frusta.height - frusta.cy, y),
    ):  # fmt: skip
        length = (focal**2 + side**2).sqrt()[:, None]
        held &= focal[:, None] * along + side[:, None] * z > -reach * length
    return held
