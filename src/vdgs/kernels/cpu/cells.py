"""Cells of space in C++: radix sort and open addressing, threaded; equal to the twin to the last bit."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from vdgs.kernels.cpu import extension
from vdgs.kernels.torch_ref import cells as reference
from vdgs.kernels.torch_ref.cells import cell_centers

__all__ = ["cell_centers", "cell_keys", "contains", "group_cells", "group_max", "morton_order"]


def cell_keys(positions: Float[Tensor, "n 3"], cell_size: float, origin: Float[Tensor, "3"]) -> Int64[Tensor, "n"]:
    """As `torch_ref.cell_keys`."""
    reference.check_lattice(positions, cell_size, origin)
    keys = torch.empty(positions.shape[0], dtype=torch.int64, device="cpu")
    exact = origin.detach().to(torch.float64).contiguous()
    if not extension.get_extension().cell_keys(positions.detach().contiguous(), cell_size, exact, keys):
        raise ValueError(reference.lattice_range_message(cell_size))
    return keys


def group_cells(keys: Int64[Tensor, "n"]) -> tuple[Int64[Tensor, "c"], Int64[Tensor, "n"]]:
    """As `torch_ref.group_cells`, by radix sort."""
    reference.check_keys(keys)
    keys = keys.contiguous()
    unique, group = torch.empty_like(keys), torch.empty_like(keys)
    count = extension.get_extension().group_cells(keys, unique, group)
    return unique[:count].clone(), group


def contains(table: Int64[Tensor, "a"], query: Int64[Tensor, "b"]) -> Bool[Tensor, "b"]:
    """As `torch_ref.contains`, by open addressing."""
    reference.check_keys(table)
    reference.check_keys(query)
    result = torch.empty(query.shape[0], dtype=torch.bool, device="cpu")
    extension.get_extension().contains(table.contiguous(), query.contiguous(), result)
    return result


def group_max(values: Float[Tensor, "n d"], group: Int64[Tensor, "n"], count: int) -> Float[Tensor, "c d"]:
    """As `torch_ref.group_max`."""
    reference.check_groups(values, group, count)
    result = values.new_empty(count, values.shape[1])
    extension.get_extension().group_max(values.detach().contiguous(), group.contiguous(), result)
    return result


def morton_order(positions: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
    """As `torch_ref.morton_order`, by radix sort."""
    reference.check_positions(positions)
    order = torch.empty(positions.shape[0], dtype=torch.int64, device="cpu")
    if positions.shape[0]:
        extension.get_extension().morton_order(positions.detach().contiguous(), order)
    return order
