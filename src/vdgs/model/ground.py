"""Where a picture shows something solid and not sky: there the scene must be opaque.

Ground is known by the places where anchors start: sparse points, and what fills the gaps between them. A picture is
cut into cells, and a cell shows known ground where at least one such place falls into it. Nothing is hidden behind
anything else: what hides such a place from a camera is as solid as the place. What else lies below the horizon is
ground too, for there is no sky.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes
from torch import Tensor

from vdgs.cameras import Camera
from vdgs.model.frustum import project
from vdgs.model.groups import Groups

#: Rays that lead down by at least this much, in degrees, end on the ground (choice: as far as the vertical of a capture
#: without GPS may be wrong).
BELOW_HORIZON_DEG = 5.0
#: Cells along the longer side of a picture (choice): wide enough to hold some of the sparse points each.
CELLS = 32


def solid_cells(ground: Float[Tensor, "g 3"], camera: Camera) -> Bool[Tensor, "rows columns"]:
    """Which cells of a camera's picture must be opaque: those that show ground of the given places, and all that lie
    below the horizon."""
    known = known_cells(ground, camera)
    return known | torch.from_numpy(below_horizon(camera, *known.shape)).to(known.device)


def solid_cells_of_all(ground: Float[Tensor, "g 3"], cameras: Sequence[Camera]) -> list[Bool[Tensor, "rows columns"]]:
    """`solid_cells` of many cameras: each looks at the places about its frustum only."""
    groups = Groups.of(ground) if len(ground) else None
    return [solid_cells(ground if groups is None else ground[groups.about(camera)], camera) for camera in cameras]


def known_cells(ground: Float[Tensor, "g 3"], camera: Camera) -> Bool[Tensor, "rows columns"]:
    """Which cells of a camera's picture show known ground, `CELLS` along its longer side.

    Gaps of a cell, and what ground encloses, count too. The outermost cells do not, unless the picture ends there: part
    of them may be sky.
    """
    longer = max(camera.width, camera.height)
    columns, rows = (max(1, round(CELLS * side / longer)) for side in (camera.width, camera.height))
    seen = project(ground, camera)
    column = (seen.column[seen.inside] * (columns / camera.width)).long().clamp(max=columns - 1)
    row = (seen.row[seen.inside] * (rows / camera.height)).long().clamp(max=rows - 1)
    held = (row * columns + column).bincount(minlength=rows * columns).reshape(rows, columns).cpu().numpy() > 0
    around = np.ones((3, 3), bool)
    # Beyond the picture is what its edge shows.
    closed = binary_closing(np.pad(held, 2, mode="edge"), around)[2:-2, 2:-2]
    return torch.from_numpy(binary_erosion(binary_fill_holes(closed), around, border_value=1)).to(ground.device)


def below_horizon(camera: Camera, rows: int, columns: int) -> Bool[np.ndarray, "rows columns"]:
    """Cells through whose centre the view leads down (z is up)."""
    if camera.model == "orthographic":
        return np.full((rows, columns), camera.forward[2] < 0)
    x = ((np.arange(columns) + 0.5) * (camera.width / columns) - camera.cx) / camera.fx
    y = ((np.arange(rows) + 0.5) * (camera.height / rows) - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((rows, columns))], axis=-1)
    up = rays @ camera.camera_from_world[:3, 2] / np.linalg.norm(rays, axis=-1)
    return up < -np.sin(np.radians(BELOW_HORIZON_DEG))


def at_size(cells: Shaped[Tensor, "rows columns"], width: int, height: int) -> Shaped[Tensor, "height width"]:
    """The cell of every pixel of a picture."""
    row, column = (
        ((torch.arange(pixels, device=cells.device) + 0.5) * (count / pixels)).long()
        for pixels, count in ((height, cells.shape[0]), (width, cells.shape[1]))
    )
    return cells[row[:, None], column]
