"""One piece of baking a scene, as a command of its own (`export.steps`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from vdgs.errors import RunError
from vdgs.executors.work import at_work
from vdgs.export.baking import Seen, fitted, part_of, shown_in
from vdgs.export.formats.spool import flat, opened
from vdgs.export.refit import Baked, added, lacking, rows_of
from vdgs.export.saved import load_array, load_lacking, load_shown, save_added, save_lacking, save_shown
from vdgs.export.steps import COMPARE, FIT, SURVEY, BakingWork, Step, as_files_hold
from vdgs.export.working import in_order
from vdgs.kernels.spherical_harmonics import function_count
from vdgs.runs.opening import TrainedRun, open_run
from vdgs.settings.requests import ExportRequest
from vdgs.storage.files import write_array
from vdgs.watching.interrupts import stop_if_asked

#: Works on an item, by its place among those of its step, and returns what writes what it came to into a file.
Do = Callable[[int], Callable[[Path], None]]


def bake_piece(asked: ExportRequest, index: int, console: Console) -> None:
    """Do one piece, continue it, or do nothing if it is done. What it comes to stays beside its status until it is used
    up. Raises RunError where what it needs is not there yet."""
    asked = as_files_hold(asked)
    run = open_run(asked.run, asked.model, asked.device)
    work = BakingWork.of(run, asked)
    folder, span = work.pieces.piece(index), work.pieces.span(index)
    if work.pieces.is_done(index):
        console.print(f"{folder.path}: already done; nothing to do", highlight=False)
        return
    step = work.step_of_piece(index)
    left = [item for item in span if not work.pieces.file(item, ".npy").exists()]
    done = len(span) - len(left)
    with at_work(folder, done, len(span)) as tell:
        first, last = span.start - step.items.start, span.stop - 1 - step.items.start
        console.print(f"to {step.kind.work}: {step.kind.steps} {first} to {last} of the {run.line}", highlight=False)
        for item, write in zip(left, _results(run, asked, work, step, left), strict=True):
            stop_if_asked()
            write(work.pieces.file(item, ".npy"))
            done += 1
            tell(done)


def _results(
    run: TrainedRun, asked: ExportRequest, work: BakingWork, step: Step, left: Sequence[int]
) -> Iterator[Callable[[Path], None]]:
    """What the items come to, in their order: views one after the other, for each takes all threads; parts at once."""
    places = [item - step.items.start for item in left]
    if step.kind is SURVEY:
        return map(_surveying(run, work), places)
    kept = _kept(work)
    if step.kind is FIT:
        return in_order(_fitting(run, asked, work, kept), places)
    baked = Baked(run.model, kept, opened(work.spool_file(step.round - 1), asked.sh_degree))
    if step.kind is COMPARE:
        return map(_comparing(work, step, baked), places)
    return in_order(_mending(work, step, baked), places)


def _kept(work: BakingWork) -> np.ndarray:
    if not work.kept_file.exists():
        raise RunError(
            f"{work.pieces.folder}: nobody has chosen what is to be baked yet. The command without --piece does, and "
            "sends out pieces when it is their turn."
        )
    return load_array(work.kept_file, np.int64, 1)


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
