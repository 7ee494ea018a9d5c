"""A baked scene merged to fewer Gaussians, which then move towards the model's own pictures.

Merging alone blurs: a Gaussian in place of ten cannot know which of their edges show. Some hundred steps by the
pictures of the model (`gaussian_optimization`) let it. Memory: a part of the scene at a time while merging, 0.7 kB for
each Gaussian that is left while they move.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from rich.console import Console

from vdgs.export.color_refinement import BakedGaussians
from vdgs.export.formats.export_scene import CHUNK_SIZE, ExportScene
from vdgs.export.formats.gaussian_store import GaussianStore, plane_blocks, write_store
from vdgs.export.gaussian_optimization import optimize_gaussians
from vdgs.export.novel_cameras import endless_cameras
from vdgs.geometry.camera import Camera
from vdgs.model.gaussian_merging import group_neighbors, merge_by_moments
from vdgs.model.gaussians import Gaussians, visible_gaussian_rows
from vdgs.system.atomic_files import explain_disk_errors
from vdgs.system.console import make_progress_bar
from vdgs.system.scratch import scratch_folder
from vdgs.system.stop_signals import check_stop_requested

#: Gaussians that are merged at once, half a kilobyte each; larger scenes are cut in the plane.
BLOCK_SIZE = 1 << 21
#: Merged Gaussians move by every camera so often, and in so many steps at most.
PASSES, MAX_STEPS = 3, 600
#: They start farther from their end than baked ones. A step moves centers by so many median sizes.
RATE, CENTER_RATE = 3.0, 0.03
#: No more than these move: they must be in memory.
MAX_MOVED = 4_000_000


class MergedGaussians(BakedGaussians):
    """Merged Gaussians on the disk, of many anchors each: by their own extent one sees which touch a view."""

    def __init__(self, baked: BakedGaussians, spool: GaussianStore) -> None:
        super().__init__(baked.model, baked.is_baked.nonzero()[:, 0].numpy(), spool)

    def rows_in_view(self, anchors: Int[np.ndarray, " v"], camera: Camera) -> Int[np.ndarray, " p"]:
        found = []
        for first in range(0, len(self.spool.means), CHUNK_SIZE):
            rows = np.arange(first, min(first + CHUNK_SIZE, len(self.spool.means)))
            means, log_scales, quaternions, logits = self.spool.ellipsoids(rows)
            colors = means.new_zeros(len(rows), 0, 3)
            shown = visible_gaussian_rows(
                Gaussians(means=means, log_scales=log_scales, quaternions=quaternions, opacity_logits=logits,
                          sh0=means, shN=colors), camera)  # fmt: skip
            found.append(first + shown.numpy())
        return np.concatenate(found)


@contextmanager
def merged_scene(
    baked: BakedGaussians, weights: Float[np.ndarray, " m"], max_count: int, beside: Path,
    after_part: Callable[[int], None] = lambda done: None,
) -> Iterator[MergedGaussians]:  # fmt: skip
    """A baked scene as `max_count` Gaussians in a temporary file beside a path. `weights`: how many pixels each makes.
    `after_part` is told how many are done."""
    chunks = merged_blocks(baked.spool, weights, max_count, after_part)
    with scratch_folder(beside) as folder, explain_disk_errors(beside.parent):
        scene = ExportScene(chunks=chunks, count=max_count, degree=baked.spool.degree)
        yield MergedGaussians(baked, write_store(scene, folder / "merged"))


def merged_blocks(
    spool: GaussianStore, weights: Float[np.ndarray, " m"], max_count: int,
    after_part: Callable[[int], None] = lambda done: None, block_size: int = BLOCK_SIZE,
) -> Iterator[Gaussians]:  # fmt: skip
    """A scene merged to `max_count` Gaussians, block by block of the plane, each to its part of the number."""
    done, total = 0, len(weights)
    for block in plane_blocks(spool.means, np.arange(total), block_size):
        before, done = done, done + len(block)
        share = done * max_count // total - before * max_count // total
        if share:
            gaussians = spool.rows(block)
            groups = group_neighbors(gaussians, share, weights[block])
            yield merge_by_moments(gaussians, groups, weights[block], enlarge=1.0)  # they move to where they close gaps
        after_part(done)
        spool.release_pages()


@dataclass(frozen=True, eq=False)
class SceneMerging:
    """Makes fewer Gaussians of baked ones, in temporary files that go with `stack`."""

    baked: BakedGaussians
    #: How many pixels each makes.
    weights: Float[np.ndarray, " m"]
    beside: Path
    training: Sequence[Camera]
    console: Console
    stack: ExitStack

    def merged(self, count: int) -> MergedGaussians:
        """So many Gaussians in place of the scene, moved towards the pictures of the model."""
        began, total = time.monotonic(), len(self.weights)
        steps = min(PASSES * len(self.training), MAX_STEPS) if count <= MAX_MOVED else 0
        with make_progress_bar(self.console) as bar:
            task = bar.add_task("merging Gaussians", total=total)

            def after_part(done: int) -> None:
                check_stop_requested()
                bar.update(task, completed=done)

            merged = self.stack.enter_context(merged_scene(self.baked, self.weights, count, self.beside, after_part))
            task = bar.add_task("moving merged Gaussians", total=steps)

            def after_step(passed: float) -> None:
                check_stop_requested()
                bar.advance(task)

            if steps:
                optimize_gaussians(
                    merged,
                    endless_cameras(self.training),
                    after_step=after_step,
                    max_steps=steps,
                    rate=RATE,
                    center_rate=CENTER_RATE,
                )
        self.console.print(
            f"merged {total:,} Gaussians to {count:,} in {time.monotonic() - began:.1f} s, moved in {steps} steps",
            highlight=False,
        )
        return merged
