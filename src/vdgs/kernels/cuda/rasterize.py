"""Splats to a picture on a GPU (source/rasterize.cu): `torch_ref.rasterize`, tile by tile."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from vdgs.kernels.autograd import (
    Drawn,
    check_picture_gradients,
    check_splat_outputs,
    check_splats,
    rasterize_with_autograd,
)
from vdgs.kernels.cuda.launch import CudaProgram, KernelArgument
from vdgs.kernels.kernel_types import OrderedSplats, Raster, RasterGradients, RasterPullback, SplatContributions, Splats
from vdgs.kernels.splat_segments import SplatSegments
from vdgs.kernels.torch_ref.rasterize import splat_contributions_from_vjp

#: Side of a tile, threads of a block and sums of an entry: kTile, kThreads and kSums of the source.
TILE_PX, THREADS, SUMS_PER_ENTRY = 16, 256, 10
#: Threads of a block of the backward pass: kBackThreads.
BACK_THREADS = 128
PROGRAM = CudaProgram(name="rasterize.cu", headers=("image_formation.h",))


def rasterize(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    *,
    depth: bool = False,
    program: CudaProgram = PROGRAM,
) -> Raster:
    """As `cpu.rasterize`, for float32 tensors on a CUDA device, median depth included. Deterministic.

    Waits for the device once, for the number of entries (splats times the tiles that they reach). Backward takes 52
    bytes an entry, and reads the splats again: RuntimeError where they or the image were changed in between. Raises
    TypeError or ValueError for unsuitable tensors, CudaUnavailable where kernels cannot be run.
    """
    runs = _runs_of(splats)
    return rasterize_with_autograd(lambda t: _draw(t, runs, width, height, depth, program), splats, background)


def rasterize_vjp(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    *,
    depth: bool = False,
    program: CudaProgram = PROGRAM,
) -> tuple[Raster, RasterPullback]:
    """`rasterize` without autograd: the image, and its pullback, which reads the splats again."""
    return _draw((*splats.tensors, background), _runs_of(splats), width, height, depth, program).with_pullback()


def splat_contributions(
    splats: Splats,
    background: Float[Tensor, "3"],
    width: int,
    height: int,
    wanted: Float[Tensor, "h w 3"] | None = None,
) -> SplatContributions:
    """As `torch_ref.splat_contributions`, by the whole backward pass."""
    return splat_contributions_from_vjp(rasterize_vjp, splats, background, width, height, wanted)


def _runs_of(splats: Splats) -> SplatSegments | None:
    return splats.segments if isinstance(splats, OrderedSplats) else None


@dataclass(frozen=True)
class _Entries:
    """What each tile shows, front to back: an entry for each pair of a splat and a tile that it reaches. Before sorting
    they are in the order of the splats: that of the rows, or `splats`."""

    owners: Int32[Tensor, " n"]  # the splat of each entry, before sorting
    order: Int64[Tensor, " n"]  # where each entry was before sorting
    bounds: Int64[Tensor, " tiles_and_one"]  # where those of each tile begin
    ends: Int64[Tensor, " m"]  # where those of each splat end, before sorting
    splats: Int32[Tensor, " m"] | None  # the rows of splats in their order; None: as they stand


def _draw(
    tensors: tuple[Tensor, ...], runs: SplatSegments | None, width: int, height: int, depth: bool, program: CudaProgram
) -> Drawn:
    """The picture of means_px, conics, colors, opacities, depths before a background, and the way back."""
    check_splats(tensors, width, height)
    *splats, background = (t.detach().contiguous() for t in tensors)
    grid = -(-width // TILE_PX), -(-height // TILE_PX)
    entries = _entries(splats, runs, grid, program)
    image, transmittance = background.new_empty(height, width, 3), background.new_empty(height, width)
    last = torch.empty_like(transmittance, dtype=torch.int32)
    depths = (torch.empty_like(transmittance), torch.empty_like(transmittance)) if depth else (None, None)
    program.launch(
        "rasterize_forward", grid, (THREADS,), *splats, entries.owners, entries.order, entries.bounds, background,
        ctypes.c_int(width), ctypes.c_int(height), image, transmittance, last, *depths,
    )  # fmt: skip

    def back(image: Tensor, depth: Tensor | None, *splats: Tensor) -> _Pullback:
        return _Pullback(image, depth, program, list(splats), background, entries, transmittance, last)

    return Drawn(Raster(image, 1.0 - transmittance, *depths), (image, depths[0], *splats), back)


def _order(runs: SplatSegments, m: int, program: CudaProgram) -> Int32[Tensor, " m"]:
    """`SplatSegments.order` in one pass: a warp a run."""
    order, count = runs.starts.new_empty(m), len(runs.starts)
    ends = runs.lengths.cumsum(0, dtype=torch.int32)
    program.launch("order_splats", _over(32 * count), (THREADS,), runs.starts, ends, ctypes.c_int(count), order)
    return order


def _entries(splats: list[Tensor], runs: SplatSegments | None, grid: tuple[int, int], program: CudaProgram) -> _Entries:
    means = splats[0]
    count, (columns, rows) = len(means), grid
    order = None if runs is None else _order(runs, count, program)
    sides = order, ctypes.c_longlong(count), ctypes.c_int(columns), ctypes.c_int(rows)
    tiles = means.new_empty(count, dtype=torch.int64)
    program.launch("splat_tiles", _over(count), (THREADS,), *splats, *sides, tiles)
    ends = tiles.cumsum(0)
    # The one wait for the device in a picture: memory must be asked for by its size.
    total = int(ends[-1]) if count else 0
    keys, owners = means.new_empty(total, dtype=torch.int64), means.new_empty(total, dtype=torch.int32)
    program.launch("splat_entries", _over(count), (THREADS,), *splats, *sides, ends, keys, owners)
    ordered, before = torch.sort(keys, stable=True)
    begins = torch.arange(columns * rows + 1, device=means.device) << 32
    return _Entries(owners, before, torch.searchsorted(ordered, begins), ends, order)


@dataclass(frozen=True)
class _Pullback:
    """A `RasterPullback` and what it reads."""

    image: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"] | None
    program: CudaProgram
    splats: list[Tensor]
    background: Tensor
    entries: _Entries
    transmittance: Float[Tensor, "h w"]
    last: Int32[Tensor, "h w"]

    def __call__(
        self,
        image: Tensor | None,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        out: tuple[Tensor, Tensor] | None = None,
        count: int | None = None,
    ) -> RasterGradients:
        means, conics, colors, opacities, depths = self.splats
        entries, (height, width) = self.entries, self.transmittance.shape
        check_picture_gradients(height, width, image, alpha, depth)
        wanted = [None if g is None else g.contiguous() for g in (image, alpha, depth)]
        n = len(means) if count is None else count
        by_means, by_conics = out or (means.new_empty(n, 2), conics.new_empty(n, 3))
        check_splat_outputs(len(means), n, by_means, by_conics)
        kept = ctypes.c_longlong(n)
        sums = means.new_zeros(len(entries.owners), SUMS_PER_ENTRY)
        picture: list[KernelArgument] = [self.image, self.transmittance, self.last, self.depth]
        self.program.launch(
            "rasterize_backward", (-(-width // TILE_PX), -(-height // TILE_PX)), (BACK_THREADS,), *self.splats,
            entries.owners, entries.order, entries.bounds, ctypes.c_int(width), ctypes.c_int(height), *picture,
            *wanted, kept, sums,
        )  # fmt: skip
        by_colors, by_opacities = colors.new_empty(n, 3), opacities.new_empty(n)
        by_depths = None if self.depth is None else depths.new_empty(n)
        self.program.launch(
            "gather_gradients", _over(len(means)), (THREADS,), *self.splats, entries.splats,
            ctypes.c_longlong(len(means)), entries.ends, sums, kept, by_means, by_conics, by_colors, by_opacities,
            by_depths,
        )  # fmt: skip
        by_background = torch.zeros_like(self.background)
        if wanted[0] is not None:
            by_background = self.transmittance.view(-1) @ wanted[0].view(-1, 3)
        return RasterGradients(by_means, by_conics, by_colors, by_opacities, by_depths, by_background)


def _over(count: int) -> tuple[int]:
    """The grid of a kernel with a thread for each of so many."""
    return (-(-count // THREADS),)
