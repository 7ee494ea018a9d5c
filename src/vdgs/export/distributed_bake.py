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
from vdgs.distributed.node_check import NodeRequirements, image_and_mask_files
from vdgs.distributed.sharded_job import ExecutionOptions, ShardNeeds
from vdgs.errors import RunError
from vdgs.export.bake import gaussian_count, part_size
from vdgs.export.bake_io import load_array, load_color_updates, load_contributions
from vdgs.export.bake_plan import BAKE_FOLDER, COMPARE, FIT, SURVEY, UPDATE_COLORS, BakePlan, BakeStep
from vdgs.export.formats.export_scene import ExportScene
from vdgs.export.formats.gaussian_store import GaussianStore, open_store, unflatten, write_store
from vdgs.model.gaussians import Gaussians
from vdgs.runs.open_run import OpenedRun
from vdgs.system.atomic_files import write_array, write_atomic
from vdgs.system.memory.memory_estimate import render_bytes
from vdgs.system.stop_signals import check_stop_requested

#: Memory of fitting, for each pair of a Gaussian and a view: what is known of it, copies in double precision (a
#: choice, not measured). So many parts are fitted at once.
BYTES_PER_SAMPLE, PARALLEL_PARTS = 400, 8
#: Of comparing pictures, for each Gaussian, as if a view showed all.
BYTES_PER_GAUSSIAN = 500


@contextmanager
def distributed_bake(
    run: OpenedRun, request: ExportRequest, execution: ExecutionOptions, console: Console
) -> Iterator[DistributedBake]:
    """What lets a scene be baked in shards. All that they leave is removed at the end, if it is a good one.

    Raises RunError where another process bakes the same, or shards of an earlier command are at work.
    """
    work = BakePlan.of(run, request)
    with work.job.exclusive():
        yield DistributedBake(run, request, work, execution, console)
    _remove_if_empty(work.job.output)


def forget_shards(run: OpenedRun) -> None:
    """Remove what shards of an earlier command have left, unless they are at work: they bake for other files."""
    output = run.folder.path / BAKE_FOLDER
    with suppress(RunError):
        clear(output)
        _remove_if_empty(output / SHARDS)
        _remove_if_empty(output)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


class DistributedBake:
    """Lets shards bake the scene of a run, step by step; as `LocalBake`."""

    def __init__(
        self, run: OpenedRun, request: ExportRequest, work: BakePlan, wish: ExecutionOptions, console: Console
    ) -> None:  # fmt: skip
        self._run, self._asked, self._work, self._wish, self._console = run, request, work, wish, console
        self.training, self._last = work.training, len(work.rounds)

    def pixels(self) -> Float[np.ndarray, " g"]:
        """How many pixels each Gaussian of the model makes of what the training cameras see."""
        if not self._work.pixels_file.exists():
            step = self._work.step(SURVEY)
            self._send(step)
            pixels = np.zeros(gaussian_count(self._run.model), np.float32)
            for file in self._work.files(step):  # in the order of one process: sums have its bits
                check_stop_requested()
                view = load_contributions(file)
                pixels[view.gaussians.numpy()] += view.pixels.numpy()
            write_array(self._work.pixels_file, pixels)
        return np.array(load_array(self._work.pixels_file, np.float32, 1))

    @contextmanager
    def spool(self, kept: Int[np.ndarray, " m"]) -> Iterator[GaussianStore]:
        """These Gaussians in a file; `pixels` was asked before."""
        work = self._work
        if not work.selection_file.exists():
            write_array(work.selection_file, kept.astype(np.int64))
        there = [number for number in range(self._last + 1) if work.store_file(number).exists()]
        for number in range(max(there, default=-1) + 1, self._last + 1):
            for step in work.steps_of_round(number):
                self._send(step)
            self._gather(number, len(kept))
            self._tidy(number)
        file = work.store_file(self._last)
        if self._asked.optimize_seconds > 0:  # which changes it: what shards came to stays as it is
            file = Path(shutil.copyfile(file, file.with_name("refined.spool")))
        spool = open_store(file, self._asked.baked_sh_degree, writable=self._asked.optimize_seconds > 0)
        yield replace(spool, means=np.array(spool.means))

    def _gather(self, number: int, count: int) -> None:
        """Make the Gaussians of a round of what its shards came to: a part at a time."""

        def write(file: Path) -> None:
            if number == 0:
                write_store(ExportScene(chunks=self._parts(), count=count, degree=self._asked.baked_sh_degree), file)
                return
            shutil.copyfile(self._work.store_file(number - 1), file)
            spool = open_store(file, self._asked.baked_sh_degree, writable=True)
            for part in self._work.files(self._work.step(UPDATE_COLORS, number)):
                check_stop_requested()
                spool.add_sh(*load_color_updates(part))

        write_atomic(self._work.store_file(number), write)

    def _parts(self) -> Iterator[Gaussians]:
        for file in self._work.files(self._work.step(FIT)):
            check_stop_requested()
            rows = load_array(file, np.float32, 2)
            if len(rows):
                yield unflatten(torch.from_numpy(rows), self._asked.baked_sh_degree)

    def _tidy(self, number: int) -> None:
        """Remove what is used up once the Gaussians of a round are there."""
        steps = self._work.steps_of_round(number) + ([self._work.step(SURVEY)] if number == 0 else [])
        for step in steps:
            for file in self._work.files(step):
                file.unlink(missing_ok=True)
        if number:
            self._work.store_file(number - 1).unlink(missing_ok=True)

    def _send(self, step: BakeStep) -> None:
        """Let the shards of a step be done that are not."""
        job = replace(self._work.job, kind=step.kind)
        if left := [index for index in step.shards if not job.is_done(index)]:
            needs = ShardNeeds(self._shard_bytes(step), self._question)
            # No photographs are read.
            job.send(left, len(step.shards), needs, replace(self._wish, image_gb=1e-9), self._console)

    def _question(self) -> NodeRequirements:
        run = self._run
        photographs = image_and_mask_files(run.capture.train_views)
        return NodeRequirements(self._work.job.folder, [run.folder.config_file, run.model_path, *photographs])

    def _shard_bytes(self, step: BakeStep) -> int:
        """Memory by estimate."""
        model = self._run.model_path.stat().st_size
        if step.kind in (SURVEY, COMPARE):
            held = BYTES_PER_GAUSSIAN * gaussian_count(self._run.model) if step.kind is COMPARE else 0
            return render_bytes(model, held, max(camera.width * camera.height for camera in self.training))
        before = self._work.step(COMPARE, step.round) if step.kind is UPDATE_COLORS else self._work.step(SURVEY)
        pairs = sum(file.stat().st_size for file in self._work.files(before)) // (
            12 if step.kind is UPDATE_COLORS else 8
        )
        most = min(PARALLEL_PARTS, len(step.items))
        return render_bytes(model, BYTES_PER_SAMPLE * pairs * most // len(step.items), part_size(self._run.model))
