"""A scene on the disk while a writer needs it in another order than it comes."""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vdgs.errors import RunError
from vdgs.export.formats.axes import Z_UP, Axes
from vdgs.export.formats.export_scene import CHUNK_SIZE, ExportScene
from vdgs.model.gaussians import Gaussians
from vdgs.system.atomic_files import write_values

#: Where a Gaussian's coefficients of the spherical harmonics begin: behind its mean, scales, quaternion and logit.
GEOMETRY_VALUES = 3 + 3 + 4 + 1


@dataclass(frozen=True, eq=False)
class GaussianStore:
    """Gaussians in a file, of which memory holds only the means [n, 3]."""

    means: np.ndarray
    table: np.ndarray
    shapes: dict[str, tuple[int, ...]]
    #: The table's pages, where what is written into them reaches the file.
    pages: mmap.mmap | None = None

    def rows(self, rows: np.ndarray) -> Gaussians:
        """The Gaussians of the given rows (indices), in their order."""
        return _unflatten(torch.from_numpy(np.array(self.table[rows])), self.shapes)

    def ellipsoids(self, rows: np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Means [r, 3], log-scales [r, 3], quaternions [r, 4] and logits [r] of the given rows, in their order."""
        columns = torch.from_numpy(self.table)[:, :GEOMETRY_VALUES].index_select(0, torch.from_numpy(rows))
        means, log_scales, quaternions, logits = (each.contiguous() for each in columns.split([3, 3, 4, 1], 1))
        return means, log_scales, quaternions, logits[:, 0]

    @property
    def coefficients(self) -> Float[Tensor, "n c"]:
        """Of the spherical harmonics of all, on the disk: RGB of the constant function first."""
        return torch.from_numpy(self.table)[:, GEOMETRY_VALUES:]

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return math.isqrt(self.shapes["shN"][0] + 1) - 1

    def add_sh(self, rows: np.ndarray, added: Float[Tensor, "n f 3"]) -> None:
        """Add to the coefficients of the Gaussians of the given rows, each named once: of the constant function first.
        Threads may do so at once for different rows."""
        if len(rows):
            self.table[rows, -added[0].numel() :] += added.reshape(len(added), -1).numpy()

    def values(self, name: str) -> Iterator[Float[np.ndarray, "b *shape"]]:
        """One quantity of all Gaussians, some thousand at a time."""
        widths = {each: math.prod(shape) for each, shape in self.shapes.items()}
        start = sum(widths[each] for each in list(widths)[: list(widths).index(name)])
        for first in range(0, len(self.table), CHUNK_SIZE):
            part = np.array(self.table[first : first + CHUNK_SIZE, start : start + widths[name]])
            yield part.reshape(-1, *self.shapes[name])
            self.release_pages()

    def release_pages(self) -> None:
        """Leave to the system which pages of the file lie in memory. They do not count as this process' own then, and
        are there again when they are asked for. Called now and then by who looks at all Gaussians."""
        if self.pages is not None and hasattr(mmap, "MADV_DONTNEED"):
            self.pages.madvise(mmap.MADV_DONTNEED)

    def replace(self, rows: np.ndarray, gaussians: Gaussians) -> None:
        """Write Gaussians in place of those of the given rows."""
        for first in range(0, len(rows), CHUNK_SIZE):
            part = slice(first, first + CHUNK_SIZE)
            self.table[rows[part]] = flatten(gaussians.select(torch.arange(len(gaussians), device="cpu")[part]))
            self.means[rows[part]] = gaussians.means[part].numpy()

    def sample(self, max_count: int) -> Gaussians:
        """At most so many, evenly taken."""
        return self.rows(even_rows(len(self.means), max_count))


def even_rows(count: int, most: int) -> Int[np.ndarray, " m"]:
    """At most so many of `count` rows, ascending, evenly taken, first to last: in float64, for float32 would name rows
    beyond the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(np.int64))


def write_store(scene: ExportScene, file: Path, axes: Axes = Z_UP) -> GaussianStore:
    """Write all numbers of a scene to a temporary file, along these axes. The caller removes the file."""
    means, done = np.empty((scene.count, 3), np.float32), 0
    shapes: dict[str, tuple[int, ...]] = {}
    with file.open("wb") as handle:
        for piece in scene.pieces(axes):
            shapes = shapes or {name: tuple(tensor.shape[1:]) for name, tensor in piece.tensors().items()}
            write_values(handle, flatten(piece))
            means[done : done + len(piece)] = piece.means.numpy()
            done += len(piece)
    with file.open("r+b") as handle:
        pages = mmap.mmap(handle.fileno(), 0)
    return GaussianStore(means, np.frombuffer(pages, np.float32).reshape(scene.count, -1), shapes, pages)


def open_store(file: Path, degree: int, writable: bool = False) -> GaussianStore:
    """The Gaussians of this degree that `write_store` has written, on the disk, their means too. Raises RunError for a
    file that is missing or damaged."""
    shapes = value_shapes(degree)
    width = sum(int(np.prod(shape)) for shape in shapes.values())
    try:
        table = np.memmap(file, np.float32, "r+" if writable else "c").reshape(-1, width)
    except (OSError, ValueError) as error:
        raise RunError(
            f"{file}: is missing or damaged ({error}). Delete {file.parent} and run the same command again."
        ) from error
    return GaussianStore(table[:, :3], table, shapes)


def value_shapes(degree: int) -> dict[str, tuple[int, ...]]:
    """The numbers of a Gaussian, in their order."""
    num_rest = (degree + 1) ** 2 - 1
    geometry: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "log_scales": (3,),
        "quaternions": (4,),
        "opacity_logits": (),
    }
    return geometry | {"sh0": (3,), "shN": (num_rest, 3)}


def unflatten(rows: Float[Tensor, "n w"], degree: int) -> Gaussians:
    """The inverse of `flatten`."""
    return _unflatten(rows, value_shapes(degree))


def _unflatten(rows: Float[Tensor, "n w"], shapes: dict[str, tuple[int, ...]]) -> Gaussians:
    parts = rows.split([int(np.prod(shape)) for shape in shapes.values()], 1)
    named = zip(shapes.items(), parts, strict=True)
    return Gaussians(**{name: part.reshape(len(rows), *shape).contiguous() for (name, shape), part in named})


def flatten(gaussians: Gaussians) -> Float[np.ndarray, "n w"]:
    """All numbers of each, as a spool holds them."""
    columns = [tensor.reshape(len(gaussians), -1) for tensor in gaussians.tensors().values()]
    return torch.cat(columns, 1).numpy()


def plane_blocks(
    means: Float[np.ndarray, "n 3"], rows: Int[np.ndarray, " r"], most: int
) -> Iterator[Int[np.ndarray, " b"]]:
    """Rows in blocks of at most so many, halved along the longer side of the ground; ascending in each."""
    if len(rows) <= most:
        yield np.sort(rows)
        return
    plane = means[rows, :2]
    along = plane[:, int((plane.max(0) - plane.min(0)).argmax())]
    order = np.argsort(along, kind="stable")
    for half in (order[: len(order) // 2], order[len(order) // 2 :]):
        yield from plane_blocks(means, rows[half], most)


def in_memory(gaussians: Gaussians) -> GaussianStore:
    """Gaussians as a store, without a file."""
    shapes = {name: tuple(tensor.shape[1:]) for name, tensor in gaussians.tensors().items()}
    return GaussianStore(gaussians.means.numpy(), flatten(gaussians), shapes)
