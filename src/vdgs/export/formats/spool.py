"""A scene on the disk while a writer needs it in another order than it comes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from vdgs.export.formats.scene import Scene
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
            flat = [tensor.reshape(len(piece), -1) for tensor in piece.tensors().values()]
            torch.cat(flat, 1).numpy().tofile(handle)
            means[done : done + len(piece)] = piece.means.numpy()
            done += len(piece)
    width = sum(int(np.prod(shape)) for shape in shapes.values())
    return Spooled(means, np.memmap(file, np.float32, "r", shape=(scene.count, width)), shapes)
