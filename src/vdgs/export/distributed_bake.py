"""A scene baked in shards, elsewhere or by several processes: what a driver does between their steps.

What views show and lack stays on the disk, and is removed when it is used up; the driver reads a view or a part at a
time. A driver that is started again goes on where the last one was.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from rich.console import Console

from vdgs.config.commands import ExportRequest
from vdgs.distributed.job_folders import SHARDS, clear
from vdgs.distributed.node_check import Question, photographs_of
from vdgs.distributed.sharded_job import ShardNeeds, Wish
from vdgs.errors import RunError
from vdgs.export.bake import gaussian_count, part_size
from vdgs.export.bake_io import load_added, load_array, load_shown
from vdgs.export.bake_plan import COMPARE, FIT, FOLDER, MEND, SURVEY, BakingWork, Step
from vdgs.export.formats.export_scene import Scene
from vdgs.export.formats.gaussian_store import Spooled, opened, spooled, unflattened
from vdgs.model.gaussians import Gaussians
from vdgs.runs.open_run import TrainedRun
from vdgs.system.atomic_files import write_array, write_atomically
from vdgs.system.memory.memory_estimate import drawing_bytes
from vdgs.system.stop_signals import stop_if_asked

#: Memory of fitting, for each pair of a Gaussian and a view: what is known of it, copies in double precision (a
#: choice, not measured). So many parts are fitted at once.
PAIR_BYTES, PARTS_AT_ONCE = 400, 8
#: Of comparing pictures, for each Gaussian, as if a view showed all.
GAUSSIAN_BYTES = 500


@contextmanager
def baked_elsewhere(run: TrainedRun, asked: ExportRequest, wish: Wish, console: Console) -> Iterator[BakedElsewhere]:
    """What lets a scene be baked in shards. All that they leave is removed at the end, if it is a good one.

    Raises RunError where another process bakes the same, or shards of an earlier command are at work.
    """
    work = BakingWork.of(run, asked)
    with work.job.held():
        yield BakedElsewhere(run, asked, work, wish, console)
    _remove_if_empty(work.job.output)


def forget_shards(run: TrainedRun) -> None:
    """Remove what shards of an earlier command have left, unless they are at work: they bake for other files."""
    output = run.folder.path / FOLDER
    with suppress(RunError):
        clear(output)
        _remove_if_empty(output / SHARDS)
        _remove_if_empty(output)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


class BakedElsewhere:
    """Lets shards bake the scene of a run, step by step; as `BakedHere`."""

    def __init__(
        self, run: TrainedRun, asked: ExportRequest, work: BakingWork, wish: Wish, console: Console
    ) -> None:  # fmt: skip
        self._run, self._asked, self._work, self._wish, self._console = run, asked, work, wish, console
        self.training, self._last = work.training, len(work.rounds)

    def pixels(self) -> Float[np.ndarray, " g"]:
        """How many pixels each Gaussian of the model makes of what the training cameras see."""
        if not self._work.pixels_file.exists():
            step = self._work.step(SURVEY)
            self._send(step)
            pixels = np.zeros(gaussian_count(self._run.model), np.float32)
            for file in self._work.files(step):  # in the order of one process: sums have its bits
                stop_if_asked()
                view = load_shown(file)
                pixels[view.gaussians.numpy()] += view.pixels.numpy()
            write_array(self._work.pixels_file, pixels)
        return np.array(load_array(self._work.pixels_file, np.float32, 1))

    @contextmanager
    def spool(self, kept: Int[np.ndarray, " m"]) -> Iterator[Spooled]:
        """These Gaussians in a file; `pixels` was asked before."""
        work = self._work
        if not work.kept_file.exists():
            write_array(work.kept_file, kept.astype(np.int64))
        there = [number for number in range(self._last + 1) if work.spool_file(number).exists()]
        for number in range(max(there, default=-1) + 1, self._last + 1):
            for step in work.steps_of(number):
                self._send(step)
            self._gather(number, len(kept))
            self._tidy(number)
        file = work.spool_file(self._last)
        if self._asked.refine > 0:  # which changes it: what shards came to stays as it is
            file = Path(shutil.copyfile(file, file.with_name("refined.spool")))
        spool = opened(file, self._asked.sh_degree, writable=self._asked.refine > 0)
        yield replace(spool, means=np.array(spool.means))

    def _gather(self, number: int, count: int) -> None:
        """Make the Gaussians of a round of what its shards came to: a part at a time."""

        def write(file: Path) -> None:
            if number == 0:
                spooled(Scene(chunks=self._parts(), count=count, degree=self._asked.sh_degree), file)
                return
            shutil.copyfile(self._work.spool_file(number - 1), file)
            spool = opened(file, self._asked.sh_degree, writable=True)
            for part in self._work.files(self._work.step(MEND, number)):
                stop_if_asked()
                spool.add_colours(*load_added(part))

        write_atomically(self._work.spool_file(number), write)

    def _parts(self) -> Iterator[Gaussians]:
        for file in self._work.files(self._work.step(FIT)):
            stop_if_asked()
            rows = load_array(file, np.float32, 2)
            if len(rows):
                yield unflattened(torch.from_numpy(rows), self._asked.sh_degree)

    def _tidy(self, number: int) -> None:
        """Remove what is used up once the Gaussians of a round are there."""
        steps = self._work.steps_of(number) + ([self._work.step(SURVEY)] if number == 0 else [])
        for step in steps:
            for file in self._work.files(step):
                file.unlink(missing_ok=True)
        if number:
            self._work.spool_file(number - 1).unlink(missing_ok=True)

    def _send(self, step: Step) -> None:
        """Let the shards of a step be done that are not."""
        job = replace(self._work.job, kind=step.kind)
        if left := [index for index in step.shards if not job.is_done(index)]:
            needs = ShardNeeds(self._shard_bytes(step), self._question)
            # No photographs are read.
            job.send(left, len(step.shards), needs, replace(self._wish, image_gb=1e-9), self._console)

    def _question(self) -> Question:
        run = self._run
        photographs = photographs_of(run.capture.train_views)
        return Question(self._work.job.folder, [run.folder.config_file, run.model_path, *photographs])

    def _shard_bytes(self, step: Step) -> int:
        """Memory by estimate."""
        model = self._run.model_path.stat().st_size
        if step.kind in (SURVEY, COMPARE):
            held = GAUSSIAN_BYTES * gaussian_count(self._run.model) if step.kind is COMPARE else 0
            return drawing_bytes(model, held, max(camera.width * camera.height for camera in self.training))
        before = self._work.step(COMPARE, step.round) if step.kind is MEND else self._work.step(SURVEY)
        pairs = sum(file.stat().st_size for file in self._work.files(before)) // (12 if step.kind is MEND else 8)
        most = min(PARTS_AT_ONCE, len(step.items))
        return drawing_bytes(model, PAIR_BYTES * pairs * most // len(step.items), part_size(self._run.model))
