"""Measuring a run: its test views, and for a merged scene also its blocks and their seams."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.config.commands import ModelName
from vdgs.distributed.job_folders import clear
from vdgs.distributed.job_labels import shard_kind
from vdgs.distributed.node_check import NodeRequirements, image_and_mask_files
from vdgs.distributed.shard import Results, Shard
from vdgs.distributed.sharded_job import ExecutionOptions, ShardedJob, ShardNeeds, split_ranges
from vdgs.evaluation.block_seams import SeamView, evaluate_blocks, make_block_table, save_seam_image, select_seam_views
from vdgs.evaluation.block_seams import measure_block_view as measure_view_of_blocks
from vdgs.evaluation.block_seams import summarize_blocks as conclude_blocks
from vdgs.evaluation.comparison_images import unique_file_stems
from vdgs.evaluation.evaluate_model import require_views, summarize_views
from vdgs.evaluation.evaluate_run import (
    CACHE_BYTES,
    IMAGE_CACHE_BYTES,
    EvaluationSplit,
    cached_reference_views,
    check_bins,
    evaluate_run,
    evaluation_folder,
    make_block_inputs,
    make_evaluation_settings,
    make_renderable_model,
    select_views,
)
from vdgs.evaluation.lpips import load_lpips
from vdgs.evaluation.renderable_model import ModelMetadata
from vdgs.evaluation.view_metrics import ViewInputs, measure_view
from vdgs.evaluation.view_metrics_io import load_view_metrics, save_view_metrics
from vdgs.runs.open_run import ModelLocation, load_run_blocks, locate_model
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.system.atomic_files import read_json, read_json_or_empty, write_bytes, write_json
from vdgs.system.documents import MeasuredAs
from vdgs.system.file_locks import lock_folder
from vdgs.system.memory.memory_estimate import render_bytes
from vdgs.system.memory.process_memory import peak_memory_bytes, reset_peak_memory
from vdgs.system.records import record_from_dict, record_to_dict

#: Views of a shard, least and most, and how many shards there are in between (choice): a process of its own is worth
#: some views, and what is lost with one is little.
VIEWS_OF_SHARD = 3, 25, 16
VIEW_LABELS = shard_kind("measure", "views")


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """Which figures are wanted."""

    path: Path
    """The run folder."""
    which: ModelName = "best"
    lpips_weights: Path | None = None
    visibility_bins: int = 4
    views: EvaluationSplit = "test"
    device: str = "cpu"


def evaluate_stage(
    context: RunContext, request: EvaluationRequest, console: Console, execution: ExecutionOptions | None = None
) -> None:
    """Measure a model of a run; of the merged one, on test views, also block by block and at the seams.

    In this process, or in shards where a `wish` sends them: the figures are the same, but for times.

    Raises what `ShardedJob.send` raises, and RunError where another process measures the same.
    """
    check_bins(request.visibility_bins)
    run = RunFolder(Path(os.path.abspath(request.path)))  # as in `stages.train`: other machines may mount it so
    found = locate_model(run, request.which)
    output = evaluation_folder(run, found.name, request.views)
    if found.warning:
        console.print(f"[yellow]warning[/] {found.warning}", highlight=False)
    began = time.monotonic()
    if execution is not None and execution.is_distributed:
        peak = _measure_in_shards(context, run, found, request, execution, console)
    else:
        peak = _measure_here(context, found, request, console)
    record = _record_of(run, found.name, request.lpips_weights, request.visibility_bins)
    write_json(output / "status.json", record | {"seconds": time.monotonic() - began, "peak_memory_bytes": peak})


def _measure_here(context: RunContext, found: ModelLocation, request: EvaluationRequest, console: Console) -> int:
    """Measure in this process; the most memory that it took (bytes)."""
    run = context.run
    output = evaluation_folder(run, found.name, request.views)
    with lock_folder(output):
        clear(output)
        opened = context.open_model(request.which, request.device)
        coarse = context.open_model("coarse", request.device)
        _announce(found, len(select_views(opened.capture, request.views)), request.views, console)
        _delete_results(output)
        reset_peak_memory()
        evaluate_run(opened, coarse, request.lpips_weights, request.visibility_bins, console, request.views)
        if _has_seams(run, found.name, request.views):
            with cached_reference_views(opened.capture.test_views) as photographs:
                console.print(make_block_table(evaluate_blocks(make_block_inputs(opened, coarse, photographs), output)))
    return peak_memory_bytes()


def _announce(found: ModelLocation, count: int, views: EvaluationSplit, console: Console) -> None:
    console.print(f"measuring the {found.summary} on {count} {views} views", highlight=False)


def _has_seams(run: RunFolder, name: str, views: EvaluationSplit) -> bool:
    """Whether blocks and the seams between them are measured too."""
    return views == "test" and name == "merged" and len(load_run_blocks(run)) > 1


def _measure_in_shards(
    context: RunContext,
    run: RunFolder,
    found: ModelLocation,
    asked: EvaluationRequest,
    wish: ExecutionOptions,
    console: Console,
) -> int:
    """Let shards of the views be measured elsewhere, and join them; the most memory that one took (bytes). No model is
    in the memory of this process."""
    context.release_models()
    output, capture = evaluation_folder(run, found.name, asked.views), context.capture
    views = select_views(capture, asked.views)
    require_views(views, output)
    weights = None if asked.lpips_weights is None else Path(os.path.abspath(asked.lpips_weights))
    job = _job(run, found, replace(asked, path=run.path, which=found.name, lpips_weights=weights), len(views))
    files = [run.config_file, run.coarse.model, found.stage.model, *image_and_mask_files(views)]
    with lock_folder(output), job.exclusive():
        _announce(found, len(views), asked.views, console)
        _delete_results(output)
        needs = ShardNeeds(_shard_bytes(run, found, asked, capture), lambda: NodeRequirements(job.folder, files))
        job.run(needs, replace(wish, image_gb=IMAGE_CACHE_BYTES / 1e9), console)
        _join(run, found, asked, job, console)
        return job.peak_memory_bytes


def _job(run: RunFolder, found: ModelLocation, asked: EvaluationRequest, count: int) -> ShardedJob:
    """The views in shards, and what their figures depend on."""
    blocks = [folder.status().model_id for folder in run.block_folders()] if found.name == "merged" else []
    depends_on = [
        found.stage.status().model_id, found.key, run.coarse_model_id(), blocks, str(asked.lpips_weights), asked.views
    ]  # fmt: skip
    if exposed := _exposed(run):
        depends_on.append(exposed)
    output = evaluation_folder(run, found.name, asked.views)
    return ShardedJob.create("views", asked, output, VIEW_LABELS, depends_on, split_ranges(count, *VIEWS_OF_SHARD))


def _shard_bytes(run: RunFolder, found: ModelLocation, asked: EvaluationRequest, capture: Capture) -> int:
    """Memory by estimate: the models that are drawn, blocks among them as far as they are held, and one picture."""
    models = [run.coarse.model, found.stage.model] + ([run.coarse.model] if found.name == "merged" else [])
    held = CACHE_BYTES if _has_seams(run, found.name, asked.views) else 0
    pixels = max(view.camera.width * view.camera.height for view in select_views(capture, asked.views))
    files = sum(model.stat().st_size for model in models)
    return render_bytes(files, min(held, files), pixels, asked.lpips_weights is not None)


def measure_shard(shard: Shard) -> None:
    """Measure a shard of the views. What they come to stays beside its status until all are joined; pictures go where
    they belong."""
    asked = shard.request(EvaluationRequest)
    run, context = RunFolder(asked.path), RunContext.from_path(asked.path)
    opened, coarse = (context.open_model(which, shard.device) for which in (asked.which, "coarse"))
    views = select_views(opened.capture, asked.views)
    job = _job(run, locate_model(run, asked.which), asked, len(views))

    def results(left: Sequence[int]) -> Results:
        with cached_reference_views(views) as photographs:
            lpips, note = load_lpips(asked.lpips_weights)
            model = make_renderable_model(opened, coarse, asked.views)
            inputs = ViewInputs(
                photographs, model, lpips, make_evaluation_settings(asked.visibility_bins, asked.views), job.output
            )
            seams = (
                make_block_inputs(opened, coarse, photographs) if _has_seams(run, opened.name, asked.views) else None
            )
            facts = {"model": record_to_dict(model.metadata), "lpips_note": note}
            write_json(job.shard(shard.index).path / "facts.json", facts)
            shard.console.print(f"measuring the {opened.summary} on {len(left)} views", highlight=False)
            pictures = _SeamPictures(job, job.spans[shard.index]) if seams is not None else None
            for item in left:
                metrics, block_metrics = measure_view(item, inputs), None
                if seams is not None and pictures is not None:
                    block_metrics, seen = measure_view_of_blocks(views[item], inputs.stems[item], seams)
                    pictures.keep(item, seen)
                yield partial(save_view_metrics, metrics=metrics, block_metrics=block_metrics)

    shard.do(job, results)


class _SeamPictures:
    """Pictures of the views of a shard that are worth seeing, of those that are measured so far."""

    def __init__(self, job: ShardedJob, span: range):
        self._job = job
        measured = {item: load_view_metrics(job.file(item))[1] for item in span if job.file(item).exists()}
        self._borders = {item: figures.row["border_pixels"] for item, figures in measured.items() if figures}

    def keep(self, item: int, seen: SeamView) -> None:
        """Draw a view if it is worth seeing, and remove the picture of one that no longer is."""
        self._borders[item] = seen.border_pixel_count
        items = sorted(self._borders)
        best = {items[place] for place in select_seam_views([self._borders[each] for each in items])}
        if item in best:
            save_seam_image(self._job.file(item, ".png"), seen)
        for other in set(items) - best:
            self._job.file(other, ".png").unlink(missing_ok=True)


def _join(run: RunFolder, found: ModelLocation, request: EvaluationRequest, job: ShardedJob, console: Console) -> None:
    """Gather what the views came to, in their order, a view at a time."""
    facts = read_json(job.shard(0).path / "facts.json")
    summarize_views(
        (figures for figures, _ in job.gather(load_view_metrics)),
        record_from_dict(ModelMetadata, facts["model"]),
        job.output,
        lpips_note=facts["lpips_note"],
        settings=make_evaluation_settings(request.visibility_bins, request.views),
        timed=False,
        console=console,
    )
    if _has_seams(run, found.name, request.views):
        figures = [each for _, each in job.gather(load_view_metrics) if each is not None]
        stems = unique_file_stems([each.row["name"] for each in figures])
        for item in select_seam_views([each.row["border_pixels"] for each in figures]):
            write_bytes(job.output / "seams" / f"{stems[item]}.png", job.file(item, ".png").read_bytes())
        console.print(make_block_table(conclude_blocks(figures, len(load_run_blocks(run)), job.output)))
    console.print(f"pictures and figures: {job.output}", highlight=False)


def is_evaluated(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> bool:
    """Whether the figures that are there are those of the model that is there, measured in this way."""
    wanted = _record_of(run, name, lpips_weights, bins)
    record = read_json_or_empty(evaluation_folder(run, name) / "status.json")
    return {key: record.get(key) for key in wanted} == wanted


def _record_of(run: RunFolder, name: str, lpips_weights: Path | None, bins: int) -> MeasuredAs:
    stage = run.merged if name == "merged" else run.coarse
    keys = run.keys()
    key = keys.merge if name == "merged" else keys.coarse
    return {
        "key": key, "model": stage.status().model_id, "lpips_weights": str(lpips_weights), "bins": bins,
        "exposed": _exposed(run),
    }  # fmt: skip


def _exposed(run: RunFolder) -> str | None:
    """How views are exposed, if training fitted exposures; None in neutral colours."""
    return "interpolated and metered" if run.method().training.exposure_compensation else None


def _delete_results(output: Path) -> None:
    """Delete what vouches for figures that are about to change, and what another cut may have left."""
    for stale in ("status.json", "metrics.json", "by_block.json"):
        (output / stale).unlink(missing_ok=True)
    shutil.rmtree(output / "seams", ignore_errors=True)
