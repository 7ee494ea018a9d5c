"""One shard of baking a scene, in a process of its own (`export.steps`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from vdgs.config.commands import ExportRequest
from vdgs.distributed.shard import Results, Shard
from vdgs.export.bake import Seen, fitted, part_of, shown_in
from vdgs.export.bake_io import load_array, load_lacking, load_shown, save_added, save_lacking, save_shown
from vdgs.export.bake_plan import COMPARE, FIT, MEND, SURVEY, BakingWork, Step, as_files_hold
from vdgs.export.color_refinement import Baked, added, lacking, rows_of
from vdgs.export.formats.gaussian_store import flat, opened
from vdgs.export.parallel import in_order
from vdgs.kernels.spherical_harmonics import function_count
from vdgs.runs.open_run import TrainedRun, open_run
from vdgs.system.atomic_files import write_array

#: Works on an item, by its place among those of its step, and returns what writes what it came to into a file.
Do = Callable[[int], Callable[[Path], None]]


def bake_shard(shard: Shard) -> None:
    """Do a shard of baking. What it comes to stays beside its status until it is used up."""
    asked = as_files_hold(shard.request(ExportRequest))
    run = open_run(asked.run, asked.model, shard.device)
    work = BakingWork.of(run, asked)

    def results(left: Sequence[int]) -> Results:
        """Views one after the other, for each takes all threads; parts at once."""
        step = work.step_of_shard(shard.index)
        shard.console.print(f"to {step.kind.work}: {len(left)} {step.kind.steps} of the {run.line}", highlight=False)
        do, side_by_side = _doing(run, asked, work, step), step.kind in (FIT, MEND)
        yield from (in_order if side_by_side else map)(do, [item - step.items.start for item in left])

    shard.do(work.job, results)


def _doing(run: TrainedRun, asked: ExportRequest, work: BakingWork, step: Step) -> Do:
    if step.kind is SURVEY:
        return _surveying(run, work)
    kept = load_array(work.kept_file, np.int64, 1)
    if step.kind is FIT:
        return _fitting(run, asked, work, kept)
    baked = Baked(run.model, kept, opened(work.spool_file(step.round - 1), asked.sh_degree))
    return _comparing(work, step, baked) if step.kind is COMPARE else _mending(work, step, baked)


def _surveying(run: TrainedRun, work: BakingWork) -> Do:
    def do(place: int) -> Callable[[Path], None]:
        shown = shown_in(run.model, work.training[place])
        return lambda path: save_shown(path, shown)

    return do


def _fitting(run: TrainedRun, asked: ExportRequest, work: BakingWork, kept: np.ndarray) -> Do:
    seen = Seen(run.model, work.training, [load_shown(file) for file in work.files(work.step(SURVEY))])
    empty = np.zeros((0, 14 + 3 * (function_count(asked.sh_degree) - 1)), np.float32)

    def do(place: int) -> Callable[[Path], None]:
        wanted = np.ascontiguousarray(part_of(kept, run.model, place))
        rows = flat(fitted(seen, wanted, asked.sh_degree)) if len(wanted) else empty
        return lambda path: write_array(path, rows)

    return do


def _comparing(work: BakingWork, step: Step, baked: Baked) -> Do:
    def do(place: int) -> Callable[[Path], None]:
        found = lacking(baked, work.cameras_of(step.round)[place])
        return lambda path: save_lacking(path, found)

    return do


def _mending(work: BakingWork, step: Step, baked: Baked) -> Do:
    views = [load_lacking(file) for file in work.files(work.step(COMPARE, step.round))]

    def do(place: int) -> Callable[[Path], None]:
        found = added(baked, work.cameras_of(step.round), views, rows_of(baked, place))
        return lambda path: save_added(path, *found)

    return do
