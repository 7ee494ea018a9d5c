"""What shards of baking leave, in .npy files that are read in part: memory holds what is looked at.

Columns of 32 bits lie behind each other, [c, p] int32, whatever their numbers are: a reader finds a range of Gaussians
in the first and takes the same range of the others.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vdgs.errors import RunError
from vdgs.export.bake import ViewContributions
from vdgs.export.color_refinement import ColorResidual
from vdgs.system.atomic_files import write_array


def load_array(path: Path, dtype: type, dimensions: int) -> np.ndarray:
    """An array on the disk; what is changed of it stays in memory. Raises RunError if the file is missing, damaged or
    of another kind."""
    try:
        array = np.load(path, mmap_mode="c", allow_pickle=False)
        if array.dtype != dtype or array.ndim != dimensions:
            raise ValueError(f"it holds {array.dtype} {array.shape}")
    except (OSError, ValueError, EOFError) as error:
        raise RunError(
            f"{path}: is missing or damaged ({error}). Delete {path.parent} and run the same command again."
        ) from error
    return np.asarray(array)


def save_contributions(path: Path, contributions: ViewContributions) -> None:
    """Write what a view shows."""
    write_array(path, np.stack([contributions.gaussians.numpy(), contributions.pixels.numpy().view(np.int32)]))


def load_contributions(path: Path) -> ViewContributions:
    """The inverse of `save_contributions`."""
    columns = load_array(path, np.int32, 2)
    return ViewContributions(torch.from_numpy(columns[0]), torch.from_numpy(columns[1].view(np.float32)))


def save_residual(path: Path, residual: ColorResidual) -> None:
    """Write what a view lacks."""
    halves = torch.cat([residual.pixels[:, None], residual.colors], 1).contiguous().numpy()
    write_array(path, np.concatenate([residual.gaussians.numpy()[None], halves.view(np.int32).reshape(2, -1)]))


def load_residual(path: Path) -> ColorResidual:
    """The inverse of `save_residual`."""
    columns = load_array(path, np.int32, 2)
    halves = torch.from_numpy(columns[1:].reshape(-1).view(np.float16).reshape(-1, 4))
    return ColorResidual(torch.from_numpy(columns[0]), halves[:, 0], halves[:, 1:])


def save_color_updates(path: Path, rows: Int[np.ndarray, " c"], colors: Float[Tensor, "c f 3"]) -> None:
    """Write what is to be added to the colors of some Gaussians."""
    numbers = colors.flatten(1).numpy().view(np.int32)
    write_array(path, np.concatenate([rows.astype(np.int32)[:, None], numbers], axis=1))


def load_color_updates(path: Path) -> tuple[Int[np.ndarray, " c"], Float[Tensor, "c f 3"]]:
    """The inverse of `save_color_updates`."""
    table = load_array(path, np.int32, 2)
    colors = np.ascontiguousarray(table[:, 1:]).view(np.float32).reshape(len(table), table.shape[1] // 3, 3)
    return table[:, 0].astype(np.int64), torch.from_numpy(colors)
