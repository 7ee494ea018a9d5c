"""Baking in shards: its steps, how each is cut, and the files between them.

Each step needs all of the one before. Shards are numbered through all steps, so that a number says what is to be done:

    survey              training views      what each shows
    fit                 parts of anchors    their Gaussians
    compare, then mend  views, then parts   what pictures lack; what is added to colors. For each of the
                                            `color_iteration_cameras`

    RUN/baking/shards/KEY/   of all shards together (`distributed.sharded_job`): pixels.npy and kept.npy, from the
                             survey; N.spool, the Gaussians after N rounds of fitting colors, the last of them alone
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from vdgs.config.commands import ExportRequest, ModelName
from vdgs.distributed.job_labels import JobLabels, shard_kind
from vdgs.distributed.sharded_job import ShardedJob, split_ranges
from vdgs.export.bake import gaussian_count, part_count
from vdgs.export.formats import registry
from vdgs.export.local_frame import default_crs
from vdgs.export.novel_cameras import color_iteration_cameras, color_iteration_count
from vdgs.geometry.camera import Camera
from vdgs.runs.open_run import OpenedRun

#: Where shards work, in the run folder.
BAKE_FOLDER = "baking"
#: Views and parts of a shard, least and most, and how many shards there are in between (choice): few, for each step
#: starts its processes anew.
VIEWS_OF_SHARD, PARTS_OF_SHARD = (16, 100, 8), (4, 50, 8)
SURVEY = shard_kind("survey views", "views")
FIT = shard_kind("fit Gaussians", "parts")
COMPARE = shard_kind("compare pictures", "views")
UPDATE_COLORS = shard_kind("fit colors again", "parts")


@dataclass(frozen=True)
class BakeStep:
    """A step of the work. Its items and shards are numbered through all steps."""

    kind: JobLabels
    round: int
    """0: before colors are fitted again."""
    items: range
    shards: range


@dataclass(frozen=True)
class BakePlan:
    """All steps of baking a scene."""

    job: ShardedJob
    steps: tuple[BakeStep, ...]
    training: Sequence[Camera]
    rounds: tuple[Sequence[Camera], ...]
    """By which pictures are compared."""

    @staticmethod
    def of(run: OpenedRun, request: ExportRequest) -> BakePlan:
        """What baking a run as it is asked for (`drop_unused_sh_degrees`) comes to, and what it depends on."""
        training = [view.camera for view in run.capture.train_views]
        planned = color_iteration_cameras(
            training, color_iteration_count(request.color_iterations, gaussian_count(run.model))
        )
        steps, spans = _cut(len(training), [len(each) for each in planned], part_count(run.model))
        output = run.folder.path / BAKE_FOLDER
        job = ShardedJob.create(
            "baking", _request(run, request), output, SURVEY, _depends_on(run, request), spans, ".npy"
        )
        return BakePlan(job, steps, training, planned)

    def steps_of_round(self, round_: int) -> list[BakeStep]:
        """From what comes before the Gaussians of a round to them; before the first, what views show is known."""
        return [step for step in self.steps if step.round == round_ and step.kind is not SURVEY]

    def step(self, kind: JobLabels, round_: int = 0) -> BakeStep:
        return next(step for step in self.steps if step.kind is kind and step.round == round_)

    def step_of_shard(self, index: int) -> BakeStep:
        return next(step for step in self.steps if index in step.shards)

    def files(self, step: BakeStep) -> list[Path]:
        """What the items of a step leave, in their order."""
        return [self.job.file(item) for item in step.items]

    def round_cameras(self, round_: int) -> Sequence[Camera]:
        """By which pictures are compared in a round, from 1 on."""
        return self.rounds[round_ - 1]

    @property
    def pixels_file(self) -> Path:
        return self.job.folder / "pixels.npy"

    @property
    def selection_file(self) -> Path:
        return self.job.folder / "kept.npy"

    def store_file(self, round_: int) -> Path:
        return self.job.folder / f"{round_}.spool"


def drop_unused_sh_degrees(request: ExportRequest) -> ExportRequest:
    """Without colors that change with the direction where no file that is asked for holds them."""
    if not any(registry.format_from_path(path).holds_changing_colors for path in request.output):
        return replace(request, sh_degree=0)
    return request


def _cut(views: int, rounds: Sequence[int], parts: int) -> tuple[tuple[BakeStep, ...], list[range]]:
    steps, spans, first = list[BakeStep](), list[range](), 0
    order = [(SURVEY, 0, views), (FIT, 0, parts)]
    order += [(kind, i, n) for i, seen in enumerate(rounds, 1) for kind, n in ((COMPARE, seen), (UPDATE_COLORS, parts))]
    for kind, round_, items in order:
        own = split_ranges(items, *(VIEWS_OF_SHARD if kind in (SURVEY, COMPARE) else PARTS_OF_SHARD))
        steps.append(BakeStep(kind, round_, range(first, first + items), range(len(spans), len(spans) + len(own))))
        spans += [range(first + span.start, first + span.stop) for span in own]
        first += items
    return tuple(steps), spans


def _request(run: OpenedRun, asked: ExportRequest) -> ExportRequest:
    """What shards must know of what was asked for to find the same work."""
    return ExportRequest(
        run=Path(os.path.abspath(run.folder.path)),
        output=asked.output,
        model=cast(ModelName, run.name),
        block=asked.block,
        bbox=asked.bbox,
        min_visibility=asked.min_visibility,
        sh_degree=asked.sh_degree,
        color_iterations=asked.color_iterations,
        crs=asked.crs,
    )


def _depends_on(run: OpenedRun, request: ExportRequest) -> list[Any]:
    """The model, the degree, how often colors are fitted, and what chooses among its Gaussians."""
    crs = None if request.bbox is None else request.crs or default_crs(run.capture.ground, request.output[0])
    box = None if request.bbox is None else list(request.bbox)
    count = color_iteration_count(request.color_iterations, gaussian_count(run.model))
    return [
        run.name,
        run.key,
        run.status.model_id,
        request.baked_sh_degree,
        count,
        request.block,
        box,
        crs,
        *([f"fades out below {request.min_visibility}"] if request.min_visibility else []),
    ]
