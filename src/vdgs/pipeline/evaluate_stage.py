"""Evaluation of a run: its test views, and for a merged scene also its blocks and their seams."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from vdgs.captures.capture import Capture, View
from vdgs.captures.capture_metadata import off_path_crc
from vdgs.captures.off_path import OFF_PATH_FOLDER
from vdgs.config.commands import ModelName
from vdgs.distributed.job_folders import clear
from vdgs.distributed.job_labels import shard_kind
from vdgs.distributed.node_check import NodeRequirements, image_and_mask_files
from vdgs.distributed.shard import Results, Shard
from vdgs.distributed.sharded_job import ExecutionOptions, ShardedJob, ShardNeeds, split_ranges
from vdgs.errors import RunError
from vdgs.evaluation.block_seams import (
    SeamView,
    evaluate_blocks,
    make_block_table,
    measure_block_view,
    save_seam_image,
    select_seam_views,
    summarize_blocks,
)
from vdgs.evaluation.comparison_images import unique_file_stems
from vdgs.evaluation.evaluate_model import require_views, summarize_views
from vdgs.evaluation.evaluate_run import (
    CACHE_BYTES,
    IMAGE_CACHE_BYTES,
    cached_reference_views,
    check_bins,
    evaluate_run,
    make_block_inputs,
    make_evaluation_settings,
    make_renderable_model,
    select_views,
)
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.measured_as import EvaluationSplit, evaluation_folder, exposure_mode, measured_as
from vdgs.evaluation.renderable_model import EvaluatedModel, EvaluationSettings
from vdgs.evaluation.view_metrics import ViewInputs, measure_view
from vdgs.evaluation.view_metrics_io import load_view_metrics, save_view_metrics
from vdgs.runs.lod_folder import tree_id
from vdgs.runs.open_run import ModelLocation, OpenedRun, load_run_blocks, locate_model
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json, read_json_or_empty, write_bytes, write_json
from vdgs.system.console import print_warning
from vdgs.system.file_locks import lock_folder
from vdgs.system.memory.memory_estimate import render_bytes
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.system.records import record_from_dict, record_to_dict

#: Views of a shard, least and most, and how many shards there are in between (choice): a process of its own is worth
#: some views, and little is lost with one.
SHARD_VIEWS = 3, 25, 16
VIEW_LABELS = shard_kind("measure", "views")


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """Which model is measured on which views, and how."""

    path: Path
    """The run folder."""
    which: ModelName = "best"
    lpips_weights: Path | None = None
    visibility_bins: int = 4
    views: EvaluationSplit = "test"
    device: str = "cpu"
    lod_error: float | None = None
    """Drawn through the level-of-detail tree, at most so many pixels off; None: from all anchors."""


@dataclass(frozen=True)
class _Evaluation:
    """A request and the model of the run that it means."""

    run: RunFolder
    model: ModelLocation
    request: EvaluationRequest

    @staticmethod
    def create(request: EvaluationRequest) -> _Evaluation:
        """Raises RunError where the model is not trained."""
        run = RunFolder(Path(os.path.abspath(request.path)))  # not resolved: other machines may mount it so
        model = locate_model(run, request.which)
        return _Evaluation(run, model, replace(request, which=model.name))  # the best may be another one by and by

    @property
    def output(self) -> Path:
        return evaluation_folder(self.run, self.model.name, self.request.views, self.request.lod_error)

    @property
    def has_seams(self) -> bool:
        """Whether blocks and the seams between them are measured too."""
        is_merged = self.request.views == "test" and self.model.name == "merged" and self.request.lod_error is None
        return is_merged and len(load_run_blocks(self.run)) > 1

    @property
    def settings(self) -> EvaluationSettings:
        return make_evaluation_settings(self.request.visibility_bins, self.request.views)

    def begin(self, view_count: int, console: Console) -> None:
        """Announce the evaluation, and delete what vouches for figures that are about to change, and what blocks of
        another partition may have left."""
        summary = f"measuring the {self.model.summary} on {view_count} {self.request.views} views"
        console.print(summary, highlight=False)
        for stale in ("status.json", "metrics.json", "by_block.json"):
            (self.output / stale).unlink(missing_ok=True)
        shutil.rmtree(self.output / "seams", ignore_errors=True)

    def job(self, capture: Capture) -> ShardedJob:
        """The views in shards, and what their figures depend on."""
        run, model, request = self.run, self.model, self.request
        weights = None if request.lpips_weights is None else Path(os.path.abspath(request.lpips_weights))
        request = replace(request, path=run.path, lpips_weights=weights)
        blocks = [folder.status().model_id for folder in run.block_folders()] if model.name == "merged" else []
        depends_on = [
            model.stage.status().model_id, model.key, run.coarse_model_id(), blocks, str(weights), request.views
        ]  # fmt: skip
        if request.lod_error is not None:
            depends_on += [f"{request.lod_error}", tree_id(run)]
        if request.views == "off-path":  # other views are those that the model was trained beside
            depends_on.append(f"{off_path_crc(capture)}")
        if exposure := exposure_mode(run):
            depends_on.append(exposure)
        spans = split_ranges(len(select_views(capture, request.views)), *SHARD_VIEWS)
        return ShardedJob.create("views", request, self.output, VIEW_LABELS, depends_on, spans)

    def shard_bytes(self, views: Sequence[View]) -> int:
        """Memory by estimate: the models that are drawn, cached blocks among them, and one image."""
        coarse, model = self.run.coarse.model, self.model.stage.model
        files = [coarse, model] + ([coarse] if self.model.name == "merged" else [])
        size = sum(file.stat().st_size for file in files)
        cached = CACHE_BYTES if self.has_seams else 0
        pixels = max(view.camera.width * view.camera.height for view in views)
        return render_bytes(size, min(cached, size), pixels, self.request.lpips_weights is not None)


def evaluate_stage(
    context: RunContext, request: EvaluationRequest, console: Console, execution: ExecutionOptions | None = None
) -> None:
    """Measure a model of a run; of the merged one, on test views, also block by block and at the seams.

    In this process, or in shards where `execution` is distributed: the figures are the same, but for times.

    Raises what `ShardedJob.send` raises, and RunError where another process measures the same.
    """
    check_bins(request.visibility_bins)
    if request.views == "off-path" and not context.capture.off_path_views:
        raise RunError(
            f"{context.capture.root}: brings no photographs from where nobody flew (folder {OFF_PATH_FOLDER}, which "
            "`vdgs synth` writes). Leave parts of the flight out instead, with --split strips or --split obliques."
        )
    if request.views == "test" and context.capture.off_path_views:
        # First: where there are figures of test views, all is measured.
        evaluate_stage(context, replace(request, views="off-path"), console, execution)
    evaluation = _Evaluation.create(request)
    run, model = evaluation.run, evaluation.model
    print_warning(console, model.warning)
    # Before: a merge meanwhile makes another model, and figures that are out of date.
    record = measured_as(run, model.name, request.lpips_weights, request.visibility_bins)
    if request.views == "off-path":
        record["off_path"] = off_path_crc(context.capture)
    start = time.monotonic()
    if execution is not None and execution.is_distributed:
        peak = _evaluate_in_shards(context, evaluation, execution, console)
    else:
        peak = _evaluate_here(context, evaluation, console)
    if (
        request.lod_error is not None
        and read_json(evaluation.output / "metrics.json")["psnr_reference_exposure"] is None
    ):
        record["exposed"] = None  # a tree in the local exposure is measured in neutral colors
    status = record | {"seconds": time.monotonic() - start, "peak_memory_bytes": peak}
    write_json(evaluation.output / "status.json", status)


def is_off_path_measured(context: RunContext, name: ModelName) -> bool:
    """Whether the views from where nobody flew, their truth too, are those that a model was measured on, if there are
    any: they may be added or replaced after the training, which does without them."""
    record = read_json_or_empty(evaluation_folder(context.run, name, "off-path") / "status.json")
    return not context.capture.off_path_views or record.get("off_path") == off_path_crc(context.capture)


def _evaluate_here(context: RunContext, evaluation: _Evaluation, console: Console) -> int:
    """Measure in this process; the most memory that it took (bytes)."""
    request, output = evaluation.request, evaluation.output
    with lock_folder(output):
        clear(output)
        opened, coarse = _open(context, request, request.device)
        evaluation.begin(len(select_views(opened.capture, request.views)), console)
        reset_peak_memory()
        evaluate_run(
            opened, coarse, request.lpips_weights, request.visibility_bins, console, request.views, request.lod_error
        )
        if evaluation.has_seams:
            with cached_reference_views(opened.capture.test_views) as images:
                console.print(make_block_table(evaluate_blocks(make_block_inputs(opened, coarse, images), output)))
    return peak_memory_bytes()


def _open(context: RunContext, request: EvaluationRequest, device: str) -> tuple[OpenedRun, OpenedRun]:
    """The model that is measured, and the coarse one."""
    opened = context.open_model(request.which, device, mapped=request.lod_error is not None)
    return opened, context.open_model("coarse", device)


def _evaluate_in_shards(
    context: RunContext, evaluation: _Evaluation, execution: ExecutionOptions, console: Console
) -> int:
    """Let shards of the views be measured elsewhere, and join them; the most memory that one took (bytes). This process
    holds no model in memory."""
    context.release_models()
    run, views = evaluation.run, select_views(context.capture, evaluation.request.views)
    require_views(views, evaluation.output)
    job = evaluation.job(context.capture)
    files = [run.config_file, run.coarse.model, evaluation.model.stage.model, *image_and_mask_files(views)]
    with lock_folder(evaluation.output), job.exclusive():
        evaluation.begin(len(views), console)
        needs = ShardNeeds(evaluation.shard_bytes(views), lambda: NodeRequirements(job.folder, files))
        job.run(needs, replace(execution, image_gb=IMAGE_CACHE_BYTES / 1e9), console)
        _join(evaluation, job, console)
        return job.peak_memory_bytes


def measure_shard(shard: Shard) -> None:
    """Measure a shard of the views. The figures stay beside its status until all are joined; images go where they
    belong."""
    evaluation = _Evaluation.create(shard.request(EvaluationRequest))
    request, context = evaluation.request, RunContext.from_path(evaluation.request.path)
    opened, coarse = _open(context, request, shard.device)
    views = select_views(opened.capture, request.views)
    job = evaluation.job(opened.capture)

    def results(left: Sequence[int]) -> Results:
        with cached_reference_views(views) as images:
            lpips, note = load_lpips(request.lpips_weights)
            model = make_renderable_model(opened, coarse, request.views, request.lod_error)
            inputs = ViewInputs(images, model, lpips, evaluation.settings, job.output)
            blocks = make_block_inputs(opened, coarse, images) if evaluation.has_seams else None
            metadata = {"model": record_to_dict(model.metadata), "lpips_note": note}
            write_json(job.shard(shard.index).path / "facts.json", metadata)
            shard.console.print(f"measuring the {opened.summary} on {len(left)} views", highlight=False)
            seams = _SeamImages(job, job.spans[shard.index]) if blocks is not None else None
            for item in left:
                metrics, block_metrics = measure_view(item, inputs), None
                if blocks is not None and seams is not None:
                    block_metrics, seam_view = measure_block_view(views[item], inputs.stems[item], blocks)
                    seams.update(item, seam_view)
                yield partial(save_view_metrics, metrics=metrics, block_metrics=block_metrics)

    shard.do(job, results)


class _SeamImages:
    """Images of the seams in the views of a shard that show most of them, of those measured so far."""

    def __init__(self, job: ShardedJob, span: range):
        self._job = job
        measured = {item: load_view_metrics(job.file(item))[1] for item in span if job.file(item).exists()}
        self._border_pixels = {item: figures.row["border_pixels"] for item, figures in measured.items() if figures}

    def update(self, item: int, view: SeamView) -> None:
        """Draw a view if it is among the best, and remove the image of one that no longer is."""
        self._border_pixels[item] = view.border_pixel_count
        items = sorted(self._border_pixels)
        best = {items[index] for index in select_seam_views([self._border_pixels[each] for each in items])}
        if item in best:
            save_seam_image(self._job.file(item, ".png"), view)
        for other in set(items) - best:
            self._job.file(other, ".png").unlink(missing_ok=True)


def _join(evaluation: _Evaluation, job: ShardedJob, console: Console) -> None:
    """Gather the figures of the views, in their order, a view at a time."""
    metadata = read_json(job.shard(0).path / "facts.json")
    summarize_views(
        (metrics for metrics, _ in job.gather(load_view_metrics)),
        record_from_dict(EvaluatedModel, metadata["model"]),
        job.output,
        lpips_note=metadata["lpips_note"],
        settings=evaluation.settings,
        timed=False,
        console=console,
    )
    if evaluation.has_seams:
        figures = [each for _, each in job.gather(load_view_metrics) if each is not None]
        stems = unique_file_stems([each.row["name"] for each in figures])
        for item in select_seam_views([each.row["border_pixels"] for each in figures]):
            write_bytes(job.output / "seams" / f"{stems[item]}.png", job.file(item, ".png").read_bytes())
        block_count = len(load_run_blocks(evaluation.run))
        console.print(make_block_table(summarize_blocks(figures, block_count, job.output)))
    console.print(f"pictures and figures: {job.output}", highlight=False)
