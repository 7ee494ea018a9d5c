"""Baking in shards: its steps, how each is cut, and the files between them.

Each step needs all of the one before. Shards are numbered through all steps, so that a number says what is to be done:

    survey              training views      what each shows
    fit                 parts of anchors    their Gaussians
    compare, then mend  views, then parts   what pictures lack; what is added to colours. For each of the `rounds`

    RUN/baking/shards/KEY/   of all shards together (`executors.sharded_job`): pixels.npy and kept.npy, from the survey;
                             N.spool, the Gaussians after N rounds of fitting colours, the last of them alone
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from vdgs.config.commands import ExportRequest, ModelName
from vdgs.distributed.job_labels import Kind, shard_kind
from vdgs.distributed.sharded_job import ShardedJob, spans_of
from vdgs.export.bake import gaussian_count, part_count
from vdgs.export.formats import registry
from vdgs.export.local_frame import usual_crs
from vdgs.export.novel_cameras import round_count, rounds
from vdgs.geometry.camera import Camera
from vdgs.runs.open_run import TrainedRun

#: Where shards work, in the run folder.
FOLDER = "baking"
#: Views and parts of a shard, least and most, and how many shards there are in between (choice): few, for each step
#: starts its processes anew.
VIEWS_OF_SHARD, PARTS_OF_SHARD = (16, 100, 8), (4, 50, 8)
SURVEY = shard_kind("survey views", "views")
FIT = shard_kind("fit Gaussians", "parts")
COMPARE = shard_kind("compare pictures", "views")
MEND = shard_kind("fit colours again", "parts")


@dataclass(frozen=True)
class Step:
    """A step of the work. Its items and shards are numbered through all steps."""

    kind: Kind
    round: int
    """0: before colours are fitted again."""
    items: range
    shards: range


@dataclass(frozen=True)
class BakingWork:
    """All steps of baking a scene."""

    job: ShardedJob
    steps: tuple[Step, ...]
    training: Sequence[Camera]
    rounds: tuple[Sequence[Camera], ...]
    """By which pictures are compared."""

    @staticmethod
    def of(run: TrainedRun, asked: ExportRequest) -> BakingWork:
        """What baking a run as it is asked for (`as_files_hold`) comes to, and what it depends on."""
        training = [view.camera for view in run.capture.train_views]
        planned = rounds(training, round_count(asked.rounds, gaussian_count(run.model)))
        steps, spans = _cut(len(training), [len(each) for each in planned], part_count(run.model))
        output = run.folder.path / FOLDER
        job = ShardedJob.of("baking", _request(run, asked), output, SURVEY, _depends_on(run, asked), spans, ".npy")
        return BakingWork(job, steps, training, planned)

    def steps_of(self, round_: int) -> list[Step]:
        """From what comes before the Gaussians of a round to them; before the first, what views show is known."""
        return [step for step in self.steps if step.round == round_ and step.kind is not SURVEY]

    def step(self, kind: Kind, round_: int = 0) -> Step:
        return next(step for step in self.steps if step.kind is kind and step.round == round_)

    def step_of_shard(self, index: int) -> Step:
        return next(step for step in self.steps if index in step.shards)

    def files(self, step: Step) -> list[Path]:
        """What the items of a step leave, in their order."""
        return [self.job.file(item) for item in step.items]

    def cameras_of(self, round_: int) -> Sequence[Camera]:
        """By which pictures are compared in a round, from 1 on."""
        return self.rounds[round_ - 1]

    @property
    def pixels_file(self) -> Path:
        return self.job.folder / "pixels.npy"

    @property
    def kept_file(self) -> Path:
        return self.job.folder / "kept.npy"

    def spool_file(self, round_: int) -> Path:
        return self.job.folder / f"{round_}.spool"


def as_files_hold(asked: ExportRequest) -> ExportRequest:
    """Without colours that change with the direction where no file that is asked for holds them."""
    if all(registry.format_of(path).fixed for path in asked.to):
        return replace(asked, sh_degree=0)
    return asked


def _cut(views: int, rounds: Sequence[int], parts: int) -> tuple[tuple[Step, ...], list[range]]:
    steps, spans, first = list[Step](), list[range](), 0
    order = [(SURVEY, 0, views), (FIT, 0, parts)]
    order += [(kind, i, n) for i, seen in enumerate(rounds, 1) for kind, n in ((COMPARE, seen), (MEND, parts))]
    for kind, round_, items in order:
        own = spans_of(items, *(VIEWS_OF_SHARD if kind in (SURVEY, COMPARE) else PARTS_OF_SHARD))
        steps.append(Step(kind, round_, range(first, first + items), range(len(spans), len(spans) + len(own))))
        spans += [range(first + span.start, first + span.stop) for span in own]
        first += items
    return tuple(steps), spans


def _request(run: TrainedRun, asked: ExportRequest) -> ExportRequest:
    """What shards must know of what was asked for to find the same work."""
    return ExportRequest(
        run=Path(os.path.abspath(run.folder.path)), to=asked.to, model=cast(ModelName, run.name), block=asked.block,
        bbox=asked.bbox, max_gaussians=asked.max_gaussians, sh_degree=asked.sh_degree, rounds=asked.rounds,
        crs=asked.crs,
    )  # fmt: skip


def _depends_on(run: TrainedRun, asked: ExportRequest) -> list[Any]:
    """The model, the degree, how often colours are fitted, and what chooses among its Gaussians."""
    crs = None if asked.bbox is None else asked.crs or usual_crs(run.capture.ground, asked.to[0])
    box = None if asked.bbox is None else list(asked.bbox)
    count = round_count(asked.rounds, gaussian_count(run.model))
    return [run.name, run.key, run.status.model, asked.sh_degree, count, asked.block, box, crs, asked.max_gaussians]
