"""`vdgs run`: all stages in order, to the report. Finished stages are skipped."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Literal, cast

from rich.console import Console
from rich.markup import escape

from vdgs.captures.format_dispatch import lacks_points
from vdgs.captures.output_guard import check_output
from vdgs.config.capture_options import CaptureOptions
from vdgs.config.commands import LodRequest, OrthoRequest, RunRequest
from vdgs.config.ranges import check_ranges
from vdgs.config.validation_rules import check_config
from vdgs.distributed.backend_selection import check_backend_reachable
from vdgs.distributed.sharded_job import ExecutionOptions
from vdgs.errors import RunError, Stopped, VdgsError
from vdgs.evaluation.lpips import check_weights_file
from vdgs.evaluation.measured_as import evaluation_folder, is_evaluated
from vdgs.pipeline.build_lod import build_lod
from vdgs.pipeline.count_visibility import count_run_visibility
from vdgs.pipeline.evaluate_stage import EvaluationRequest, evaluate_stage, is_off_path_measured
from vdgs.pipeline.find_motion import find_run_motion
from vdgs.pipeline.image_size import choose_for_photographs, choose_image_size, names_size
from vdgs.pipeline.merge_blocks import merge_run_blocks
from vdgs.pipeline.partition_stage import partition_run
from vdgs.pipeline.train_blocks import train_blocks
from vdgs.pipeline.train_coarse import train_coarse
from vdgs.rendering.ortho.map_status import has_ortho_dependencies, is_ortho_current
from vdgs.rendering.ortho.render_ortho import render_ortho
from vdgs.report.status_cli import full_run_status, next_line
from vdgs.report.write_report import write_report
from vdgs.runs.create_or_resume import exclusive_run
from vdgs.runs.run_context import RunContext
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_inputs import note_inputs
from vdgs.sfm.reconstruction_plan import ReconstructionPlan
from vdgs.sfm.run_request import (
    is_image_input,
    make_posed_request,
    make_sfm_request,
    print_unused_options,
    size_apart,
)
from vdgs.sfm.sfm_estimate import SfmEstimate
from vdgs.system.atomic_files import read_json
from vdgs.system.documents import EvaluationMetrics
from vdgs.system.stop_signals import check_stop_requested

#: Levels of detail are made of a merged scene with more anchors.
LOD_MIN_ANCHORS = 1_000_000


def run_pipeline(request: RunRequest, console: Console, command: str | None = None) -> None:
    """Everything from a capture to a report, on a device that is selected already (`vdgs.kernels.device_selection`).

    `command` is the command line, saved in the run for people who want to continue it. Raises what the stages raise;
    what was finished before stays, and the same command continues.
    """
    check_backend_reachable(request.executor_options)
    check_ranges(request)
    request.checkpointing.check()
    check_weights_file(request.lpips_weights)
    check_output(request.output)
    RunFolder(request.output).check_output_empty()
    given, began_ns = request, time.time_ns()
    choice = choose_image_size(reconstruct_if_needed(request, console, command), console)
    request = choice.request
    with exclusive_run(
        request.capture, request.output, request.options, request.method(), overwrite=request.overwrite,
        command=command, capture=choice.capture,
    ) as context:  # fmt: skip
        note_inputs(context.run, given, context.capture, began_ns)
        _stages(context, request, console)
    console.print(escape(next_line(full_run_status(context.run))), highlight=False)


def reconstruct_if_needed(run_request: RunRequest, console: Console, command: str | None = None) -> RunRequest:
    """The request with a capture: photographs alone become one in RUN/capture first, at a size that is chosen before,
    with the time of the whole job, where nobody names one.

    Raises what `reconstruct` raises, RunError where another process drives the run, and VdgsError for settings that do
    not work, before the long work.
    """
    if not is_image_input(run_request):
        return _find_points(run_request, console)
    from vdgs.sfm.reconstruct import reconstruct  # imports much that a run of a capture does not need

    check_config(run_request.method())
    _title(console, "photographs")
    request = make_sfm_request(run_request)
    chosen = run_request

    def choose(plan: ReconstructionPlan, sfm: SfmEstimate) -> None:
        nonlocal chosen
        if not names_size(run_request):
            chosen = choose_for_photographs(run_request, plan, sfm, console).request

    reconstruct(request, console, RunFolder(run_request.output), command, on_estimate=choose)
    options = replace(chosen.options, gps=None, scale_bar=None)
    return replace(run_request, capture=request.output, extra_image_folders=(), options=options)


def _find_points(run_request: RunRequest, console: Console) -> RunRequest:
    """The request with a capture that has points: a project of another program without any becomes one in
    RUN/capture first."""
    posed, size = size_apart(run_request)
    if not lacks_points(posed.capture, posed.options):
        print_unused_options(run_request, console)
        return run_request
    from vdgs.sfm.posed_capture import make_posed_capture  # imports much that a run of a capture does not need

    check_config(run_request.method())
    _title(console, "points")
    request = make_posed_request(run_request)
    make_posed_capture(request, posed.options, console, RunFolder(run_request.output))
    options = replace(run_request.options, images=size, format="auto", masks=CaptureOptions.masks, undistort=False)
    return replace(run_request, capture=request.output, options=options)


def _stages(context: RunContext, request: RunRequest, console: Console) -> None:
    run = context.run
    _title(console, "coarse model")
    run.begin_step("coarse")
    train_coarse(context, request.checkpointing, console, request.device)
    check_stop_requested()
    find_run_motion(context, console, request.device)
    run.begin_step("visibility")
    count_run_visibility(context, console)
    _measure(context, "coarse", request, console)
    _title(console, "blocks")
    run.begin_step("partition")
    partition_run(context, console, request.device, _execution(request))
    _title(console, "block training")
    try:
        train_blocks(context, request.checkpointing, request.jobs, console, request.device, request.executor_options)
    except RunError as error:
        if not request.allow_missing_blocks:
            raise
        console.print(f"[yellow]note[/] {error}", highlight=False)
    _title(console, "merge and evaluation")
    run.begin_step("merge")
    merge_run_blocks(context, request.allow_missing_blocks, console)
    _measure(context, "merged", request, console)
    context.release_models("coarse")
    _print_improvement(run, console)
    if request.lod and (run.merged.status().anchors or 0) > LOD_MIN_ANCHORS:
        _lod(context, console)
    if request.ortho:
        _ortho(context, request, console)
    check_stop_requested()
    run.begin_step("report")
    console.print(f"report: {write_report(run)}", highlight=False)


def _lod(context: RunContext, console: Console) -> None:
    """Levels of detail. An error of theirs does not fail the run: it is printed."""
    _title(console, "levels of detail")
    try:
        build_lod(context, LodRequest(run=context.run.path), console)
    except Stopped:
        raise
    except VdgsError as error:
        console.print(f"[yellow]note[/] no levels of detail: {escape(str(error))}", highlight=False)


def _ortho(context: RunContext, request: RunRequest, console: Console) -> None:
    """Orthophoto, surface model and visibility. An error of a map does not fail the run: it is printed."""
    _title(console, "maps")
    run = context.run
    if not has_ortho_dependencies():
        console.print("[yellow]note[/] no maps: they need pip install 'vdgs\\[geo]'", highlight=False)
    elif is_ortho_current(run):
        console.print(f"{run.path / 'maps'}: already drawn; nothing to do", highlight=False)
    else:
        try:
            render_ortho(context, OrthoRequest(run=run.path, device=request.device), console, _execution(request))
        except Stopped:
            raise
        except VdgsError as error:
            console.print(f"[yellow]note[/] no maps: {escape(str(error))}", highlight=False)


def _title(console: Console, name: str) -> None:
    check_stop_requested()
    console.print()
    console.rule(f"[bold]{name}", align="left", style="dim")


def _measure(context: RunContext, which: Literal["coarse", "merged"], request: RunRequest, console: Console) -> None:
    """Evaluate a model unless that was done already, for this very model and in the same way."""
    check_stop_requested()
    run = context.run
    weights, bins = request.lpips_weights, request.visibility_bins
    if is_evaluated(run, which, weights, bins) and is_off_path_measured(context, which):
        console.print(f"{evaluation_folder(run, which)}: already measured; nothing to do", highlight=False)
        return
    evaluation = EvaluationRequest(
        path=run.path, which=which, lpips_weights=weights, visibility_bins=bins, device=request.device
    )
    evaluate_stage(context, evaluation, console, _execution(request))


def _execution(request: RunRequest) -> ExecutionOptions:
    """Where shards of stages other than the blocks are done: where blocks are trained, if that is a cluster."""
    options = request.executor_options
    return ExecutionOptions(options, request.jobs if options.executor != "local" else 0, device=request.device)


def _print_improvement(run: RunFolder, console: Console) -> None:
    """Print how the merged model compares with the coarse one."""
    folders = (run.coarse.path / "evaluation", run.evaluation)
    coarse, merged = (cast(EvaluationMetrics, read_json(folder / "metrics.json")) for folder in folders)
    before, after = coarse.get("psnr"), merged.get("psnr")
    if before is None or after is None:
        return
    console.print(
        f"coarse {before:.2f} dB → merged {after:.2f} dB ({after - before:+.2f}); "
        f"SSIM {coarse['ssim']:.3f} → {merged['ssim']:.3f}",
        style="bold", highlight=False,
    )  # fmt: skip
