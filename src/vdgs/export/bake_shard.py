"""One shard of baking a scene, in a process of its own (`export.bake_plan`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from vdgs.config.commands import ExportRequest
from vdgs.distributed.shard import Results, Shard
from vdgs.export.bake import BakeViews, fit_gaussians, gaussians_of_part, view_contributions
from vdgs.export.bake_io import (
    load_array,
    load_contributions,
    load_residual,
    save_color_updates,
    save_contributions,
    save_residual,
)
from vdgs.export.bake_plan import COMPARE, FIT, SURVEY, UPDATE_COLORS, BakePlan, BakeStep, drop_unused_sh_degrees
from vdgs.export.color_refinement import BakedGaussians, color_updates, rows_of_part, view_residual
from vdgs.export.formats.gaussian_store import flatten, open_store
from vdgs.export.gaussian_selection import with_faded_edge
from vdgs.export.parallel import parallel_map
from vdgs.kernels.spherical_harmonics import num_sh_bases
from vdgs.runs.open_run import OpenedRun, open_run
from vdgs.system.atomic_files import write_array

#: Works on an item, by its place among those of its step, and returns what writes what it came to into a file.
ItemWriter = Callable[[int], Callable[[Path], None]]


def bake_shard(shard: Shard) -> None:
    """Do a shard of baking. What it comes to stays beside its status until it is used up."""
    asked = drop_unused_sh_degrees(shard.request(ExportRequest))
    run = with_faded_edge(open_run(asked.run, asked.model, shard.device), asked)
    work = BakePlan.of(run, asked)

    def results(left: Sequence[int]) -> Results:
        """Views one after the other, for each takes all threads; parts at once."""
        step = work.step_of_shard(shard.index)
        shard.console.print(
            f"to {step.kind.verb}: {len(left)} {step.kind.step_unit} of the {run.summary}", highlight=False
        )
        do, side_by_side = _doing(run, asked, work, step), step.kind in (FIT, UPDATE_COLORS)
        yield from (parallel_map if side_by_side else map)(do, [item - step.items.start for item in left])

    shard.do(work.job, results)


def _doing(run: OpenedRun, asked: ExportRequest, work: BakePlan, step: BakeStep) -> ItemWriter:
    if step.kind is SURVEY:
        return _surveying(run, work)
    kept = load_array(work.selection_file, np.int64, 1)
    if step.kind is FIT:
        return _fitting(run, asked, work, kept)
    baked = BakedGaussians(run.model, kept, open_store(work.store_file(step.round - 1), asked.baked_sh_degree))
    return _comparing(work, step, baked) if step.kind is COMPARE else _mending(work, step, baked)


def _surveying(run: OpenedRun, work: BakePlan) -> ItemWriter:
    def do(place: int) -> Callable[[Path], None]:
        shown = view_contributions(run.model, work.training[place])
        return lambda path: save_contributions(path, shown)

    return do


def _fitting(run: OpenedRun, request: ExportRequest, work: BakePlan, kept: np.ndarray) -> ItemWriter:
    seen = BakeViews(run.model, work.training, [load_contributions(file) for file in work.files(work.step(SURVEY))])
    empty = np.zeros((0, 14 + 3 * (num_sh_bases(request.baked_sh_degree) - 1)), np.float32)

    def do(place: int) -> Callable[[Path], None]:
        wanted = np.ascontiguousarray(gaussians_of_part(kept, run.model, place))
        rows = flatten(fit_gaussians(seen, wanted, request.baked_sh_degree)) if len(wanted) else empty
        return lambda path: write_array(path, rows)

    return do


def _comparing(work: BakePlan, step: BakeStep, baked: BakedGaussians) -> ItemWriter:
    def do(place: int) -> Callable[[Path], None]:
        found = view_residual(baked, work.round_cameras(step.round)[place])
        return lambda path: save_residual(path, found)

    return do


def _mending(work: BakePlan, step: BakeStep, baked: BakedGaussians) -> ItemWriter:
    views = [load_residual(file) for file in work.files(work.step(COMPARE, step.round))]

    def do(place: int) -> Callable[[Path], None]:
        found = color_updates(baked, work.round_cameras(step.round), views, rows_of_part(baked, place))
        return lambda path: save_color_updates(path, *found)

    return do
