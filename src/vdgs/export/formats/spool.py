"""A scene on the disk while a writer needs it in another order than it comes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vdgs.export.formats.scene import ROWS, Scene
from vdgs.model.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Spooled:
    """Gaussians in a file, of which memory holds only the means [n, 3]."""

    means: np.ndarray
    table: np.ndarray
    shapes: dict[str, tuple[int, ...]]

    def rows(self, rows: np.ndarray) -> Gaussians:
        """The Gaussians of the given rows (indices), in their order."""
        sizes = [int(np.prod(shape)) for shape in self.shapes.values()]
        parts = torch.from_numpy(np.array(self.table[rows])).split(sizes, 1)
        named = zip(self.shapes.items(), parts, strict=True)
        return Gaussians(**{name: part.reshape(len(rows), *shape).contiguous() for (name, shape), part in named})

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return math.isqrt(self.shapes["rest"][0] + 1) - 1

    def add_colours(self, rows: np.ndarray, added: Float[Tensor, "n f 3"]) -> None:
        """Add to the coefficients of the Gaussians of the given rows, each named once: of the constant function first.
        Threads may do so at once for different rows."""
        self.table[rows, -added[0].numel() :] += added.reshape(len(added), -1).numpy()

    def replace(self, rows: np.ndarray, gaussians: Gaussians) -> None:
        """Write Gaussians in place of those of the given rows."""
        for first in range(0, len(rows), ROWS):
            part = slice(first, first + ROWS)
            self.table[rows[part]] = _flat(gaussians.select(torch.arange(len(gaussians))[part]))

    def sample(self, most: int) -> Gaussians:
        """At most so many, evenly taken."""
        count = len(self.means)
        return self.rows(np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64)))


def spooled(scene: Scene, file: Path, turn: np.ndarray | None = None) -> Spooled:
    """Write all numbers of a scene to a temporary file, turned where asked. The caller removes the file."""
    means, done = np.empty((scene.count, 3), np.float32), 0
    shapes: dict[str, tuple[int, ...]] = {}
    with file.open("wb") as handle:
        for piece in scene.pieces(turn):
            shapes = shapes or {name: tuple(tensor.shape[1:]) for name, tensor in piece.tensors().items()}
            _flat(piece).tofile(handle)
            means[done : done + len(piece)] = piece.means.numpy()
            done += len(piece)
    width = sum(int(np.prod(shape)) for shape in shapes.values())
    return Spooled(means, np.memmap(file, np.float32, "r+", shape=(scene.count, width)), shapes)


def _flat(gaussians: Gaussians) -> Float[np.ndarray, "n w"]:
    flat = [tensor.reshape(len(gaussians), -1) for tensor in gaussians.tensors().values()]
    return torch.cat(flat, 1).numpy()
