"""Cells of space and their hash, for the growth of anchors (Scaffold-GS section 3.2).

A cell is a cube of side `cell_size` in a lattice anchored at `origin`; its key packs its three signed
indices, 21 bits each, x highest. Sets of cells are compared by key, in linear time: never n × m.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

#: Bits of a key for each axis: indices reach from -2^20 to 2^20 - 1.
AXIS_BITS = 21
AXIS_OFFSET = 1 << (AXIS_BITS - 1)
AXIS_MASK = (1 << AXIS_BITS) - 1


def cell_keys(positions: Float[Tensor, "n 3"], cell_size: float, origin: Float[Tensor, "3"]) -> Int64[Tensor, "n"]:
    """Key of the cell that holds each position: floor((x - origin) / cell_size) in float64, packed.

    Keys ascend with x, then y, then z. Raises ValueError where an index does not fit 21 bits or a
    position is not finite, and for a cell size that is not positive.
    """
    check_lattice(positions, cell_size, origin)
    index = torch.floor((positions.to(torch.float64) - origin.to(torch.float64)) / cell_size) + AXIS_OFFSET
    if not bool(((index >= 0) & (index <= AXIS_MASK)).all()):
        raise ValueError(lattice_range_message(cell_size))
    x, y, z = index.to(torch.int64).unbind(dim=1)
    return (x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z


def cell_centers(keys: Int64[Tensor, "n"], cell_size: float, origin: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
    """Center of each cell, in the type of `origin`."""
    shifts = torch.tensor([2 * AXIS_BITS, AXIS_BITS, 0], device=keys.device, dtype=torch.int64)
    index = ((keys[:, None] >> shifts) & AXIS_MASK) - AXIS_OFFSET
    return ((index.to(torch.float64) + 0.5) * cell_size + origin.to(torch.float64)).to(origin.dtype)


def group_cells(keys: Int64[Tensor, "n"]) -> tuple[Int64[Tensor, "c"], Int64[Tensor, "n"]]:
    """The distinct keys, ascending, and for each of the n its place among them. O(n)."""
    check_keys(keys)
    unique, group = torch.unique(keys, return_inverse=True)
    return unique, group


def contains(table: Int64[Tensor, "a"], query: Int64[Tensor, "b"]) -> Bool[Tensor, "b"]:
    """Which of the queried keys are in the table (repetitions allowed in both). O(a + b)."""
    check_keys(table)
    check_keys(query)
    return torch.isin(query, table)


def group_max(values: Float[Tensor, "n d"], group: Int64[Tensor, "n"], count: int) -> Float[Tensor, "c d"]:
    """Elementwise maximum of the rows of each group, [count, d]; NaN wins; a group without rows is 0.

    Raises IndexError for a group outside [0, count).
    """
    check_groups(values, group, count)
    result = values.new_zeros(count, values.shape[1])
    index = group[:, None].expand_as(values)
    return result.scatter_reduce(0, index, values.detach(), "amax", include_self=False)


def morton_order(positions: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """The permutation that sorts positions along a Morton curve, stable. O(n).

    Positions are quantised to 21 bits an axis over a cube at the lower corner of their bounding box (choice: a cube, so
    that neighbors on the curve are near in a flat scene). Raises ValueError where a position is not finite.
    """
    check_positions(positions)
    if positions.shape[0] == 0:
        return positions.new_zeros(0, dtype=torch.int64)
    exact = positions.detach().to(torch.float64)
    if not bool(torch.isfinite(exact).all()):
        raise ValueError("a position is not finite")
    low = exact.amin(dim=0)
    side = float((exact.amax(dim=0) - low).max())
    scale = (1 << AXIS_BITS) / side if side > 0 else 0.0
    if not math.isfinite(scale) or not math.isfinite(side):
        raise ValueError(f"cannot quantise positions that span {side}")
    index = torch.floor((exact - low) * scale).clamp(max=AXIS_MASK).to(torch.int64)
    x, y, z = _spread(index).unbind(dim=1)
    return torch.argsort(x | (y << 1) | (z << 2), stable=True)


def _spread(index: Int64[Tensor, "n 3"]) -> Int64[Tensor, "n 3"]:
    """Move bit i to bit 3i, for the 21 bits of an axis."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        index = (index | (index << shift)) & mask
    return index


def lattice_range_message(cell_size: float) -> str:
    """What to say where a position has no key."""
    return (
        f"a position lies beyond 2^20 cells of side {cell_size:g} from the origin, or is not finite: "
        "use a larger cell or an origin nearer to the scene"
    )


def check_lattice(positions: Tensor, cell_size: float, origin: Tensor) -> None:
    """Raise a clear error unless these describe positions in a lattice."""
    check_positions(positions)
    if not origin.is_floating_point():
        raise TypeError(f"origin must be floating, not {origin.dtype}")
    if origin.shape != (3,):
        raise ValueError(f"origin must be [3], not {list(origin.shape)}")
    if not (math.isfinite(cell_size) and cell_size > 0):
        raise ValueError(f"cell_size must be positive, not {cell_size}")


def check_positions(positions: Tensor) -> None:
    """Raise a clear error unless these are positions [n, 3]."""
    if positions.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"positions must be float32 or float64, not {positions.dtype}")
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions must be [n, 3], not {list(positions.shape)}")


def check_keys(keys: Tensor) -> None:
    """Raise a clear error unless these are keys [n]."""
    if keys.dtype != torch.int64:
        raise TypeError(f"keys must be int64, not {keys.dtype}")
    if keys.ndim != 1:
        raise ValueError(f"keys must be [n], not {list(keys.shape)}")


def check_groups(values: Tensor, group: Tensor, count: int) -> None:
    """Raise a clear error unless every row of the values has one of the `count` groups."""
    if values.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"values must be float32 or float64, not {values.dtype}")
    if group.dtype != torch.int64:
        raise TypeError(f"group must be int64, not {group.dtype}")
    if values.ndim != 2 or group.shape != values.shape[:1]:
        raise ValueError(f"expected values [n, d] and group [n], got {list(values.shape)} and {list(group.shape)}")
    if group.numel() and (int(group.min()) < 0 or int(group.max()) >= count):
        raise IndexError(f"groups reach from {int(group.min())} to {int(group.max())}, of {count}")
