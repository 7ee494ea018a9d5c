"""`vdgs run --dry-run`: what a run would take, by estimate, before it begins. Nothing is written.

Time is measured, not guessed: a few steps at each size of the photographs, on this machine and with these settings. Of
photographs alone three are searched and matched, and the steps are those of a scene like theirs (`assumed_scene`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.format_dispatch import lacks_points
from vdgs.captures.loading import load_capture
from vdgs.captures.output_guard import check_not_among_inputs
from vdgs.captures.validation import find_doubts, print_doubts
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig, resolve_iterations
from vdgs.config.ranges import check_ranges
from vdgs.config.validation_rules import check_config
from vdgs.pipeline.image_size import choose_for_photographs, choose_image_size, estimate_capture
from vdgs.pipeline.run_estimate import RunEstimate
from vdgs.runs.config_file import changed_flags
from vdgs.runs.create_or_resume import capture_options_changed, run_settings
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStatus, StageStatus, get_run_status
from vdgs.sfm.films.take_frames import temporary_frames
from vdgs.sfm.posed_plan import plan_posed_capture, print_posed_plan
from vdgs.sfm.reconstruct import describe_work_left, look_at_work
from vdgs.sfm.reconstruction_plan import print_plan
from vdgs.sfm.run_request import (
    is_image_input,
    make_posed_request,
    make_sfm_request,
    print_unused_options,
    size_apart,
)
from vdgs.sfm.sfm_estimate import estimate_sfm
from vdgs.system.atomic_files import read_json
from vdgs.system.units import data_size, rough_duration

#: Photographs of a capture that are decoded to see whether they are whole (choice: some seconds).
SAMPLE = 32


def estimate_run(request: RunRequest, console: Console) -> RunEstimate:
    """Print what `vdgs run` would do and take.

    Raises what reading the capture or the photographs raises, VdgsError for bad settings.
    """
    check_ranges(request)
    method = request.method()
    check_config(method)
    RunFolder(request.output).check_output_empty()
    if is_image_input(request):
        return _estimate_from_images(request, console)
    posed, size = size_apart(request)
    if lacks_points(posed.capture, posed.options):
        return _estimate_from_poses(posed, size, console)
    print_unused_options(request, console)
    return _estimate_from_capture(request, console)


def _estimate_from_capture(request: RunRequest, console: Console, is_anew: bool = False) -> RunEstimate:
    """What remains of a run of a capture; the whole run where it is to be trained anew."""
    choice = choose_image_size(request, console)
    request = choice.request
    capture = choice.capture or load_capture(request.capture, request.options)
    check_not_among_inputs(request.output, capture)
    print_doubts(find_doubts(capture, SAMPLE), console)
    if len(capture.views) > SAMPLE:
        console.print(
            f"{SAMPLE} of {len(capture.views)} photographs were decoded; the run decodes all", highlight=False
        )
    method = request.method()
    method = replace(method, training=resolve_iterations(method.training, len(capture.train_views)))
    status = None if is_anew else _run_status(request, capture, method, console)
    estimate = choice.estimate or estimate_capture(capture, request)
    _print_estimate(estimate, method, status, console)
    return estimate


def _estimate_from_images(run_request: RunRequest, console: Console) -> RunEstimate:
    """The whole job of photographs alone; of a capture that was made of them before, what remains."""
    request, run = make_sfm_request(run_request), RunFolder(run_request.output)
    with temporary_frames(request, console) as with_frames:
        plan, left = look_at_work(with_frames, run)
        if said := describe_work_left(request, left):
            trained = "; what was trained on it is deleted" if left != "nothing" and run.is_trained else ""
            console.print(f"[yellow]note[/] {said}{trained}", highlight=False)
        if left == "all":
            sfm = estimate_sfm(plan)
            print_plan(plan, sfm.text(plan.threads), console)
            estimate = choose_for_photographs(run_request, plan, sfm, console).estimate
            assert estimate is not None
            _print_estimate(estimate, run_request.method(), None, console)
            return estimate
    options = replace(run_request.options, gps=None, scale_bar=None)
    of_capture = replace(run_request, capture=request.output, extra_image_folders=(), options=options)
    return _estimate_from_capture(of_capture, console, is_anew=left == "placing")


def _estimate_from_poses(run_request: RunRequest, size: str | None, console: Console) -> RunEstimate:
    """The whole job of a project of another program, or a data set, without points."""
    plan, sfm = plan_posed_capture(make_posed_request(run_request), run_request.options)
    print_posed_plan(plan, sfm, console)
    found = replace(run_request, options=replace(run_request.options, images=size))
    estimate = choose_for_photographs(found, plan, sfm, console).estimate
    assert estimate is not None
    _print_estimate(estimate, run_request.method(), None, console)
    return estimate


def _run_status(request: RunRequest, capture: Capture, method: MethodConfig, console: Console) -> RunStatus | None:
    """How far the run is that is there already, with the settings of the request; None where there is none."""
    run = RunFolder(request.output)
    if not run.config_file.exists():
        return None
    settings = run_settings(request.capture, request.options, method)
    if run.capture_file.exists() and not capture_options_changed(run, settings):
        check_same_capture(run.capture_file, read_json(run.capture_file), capture)
    for line in changed_flags(run.settings(), settings):
        console.print(f"[yellow]changed[/] {line}", highlight=False)
    if lost := run.find_lost(settings):
        needs = "which --overwrite deletes" if request.overwrite else "so that the run is refused without --overwrite"
        console.print(f"[yellow]warning[/] these make {' and '.join(lost)} useless, {needs}", highlight=False)
    return get_run_status(run, settings)


def _print_estimate(plan: RunEstimate, method: MethodConfig, status: RunStatus | None, console: Console) -> None:
    def done(*names: str) -> str:
        stages = [stage for stage in status.stages if stage.name in names] if status is not None else []
        return "; done already" if stages and all(stage.state == "done" for stage in stages) else ""

    def takes(*names: str) -> str:
        return rough_duration(sum(plan.times[name].seconds for name in names))

    blocks = f"{plan.blocks} block{'' if plan.blocks == 1 else 's'}"
    auto = method.partition.blocks == "auto"
    chosen = " by estimate: --blocks auto counts again when anchors have grown" if auto else ""
    stereo = f" (and at most {plan.dense_points:,} where stereo finds ground)" if plan.dense_points else ""
    names = [stage.name for stage in status.blocks] if status is not None else []
    coarse_growth, block_growth = plan.growth
    lines = [
        f"coarse model: {plan.anchors:,} anchors at the start{stereo}, {plan.coarse_iterations:,} iterations, at most "
        f"{data_size(plan.coarse_bytes)}, about {takes('stereo', 'coarse')}{done('coarse')}",
        *([f"masks of what moves: about {takes('motion')}"] if plan.times["motion"].seconds else []),
        f"{blocks}{chosen}: about {plan.block_iterations:,} iterations each, {plan.jobs} at once, at most "
        f"{data_size(plan.block_bytes)} each and {data_size(plan.images_bytes)} for photographs, about "
        f"{takes('blocks')}{done(*names)}",
        f"measuring, maps, report: about {takes('measuring', 'maps', 'other')}",
        f"memory that is free: {data_size(plan.free_bytes)}",
        f"{'the whole job' if status is None else 'what is left of the job'}: {_left(plan, status).text()}",
        f"Measured now on this machine: training steps at each size{', stereo' if plan.dense_points else ''}"
        f"{', features and matches of three photographs' if 'photographs' in plan.times else ''}. Anchors are taken to "
        f"grow {coarse_growth:.2g} times in the coarse model and {block_growth:.2g} times in blocks. Nothing was "
        "written.",
    ]
    console.print("\n".join(lines), highlight=False)
    if plan.may_exceed_memory:
        console.print(
            "[yellow]warning[/] it may run out of memory. What helps: --downscale 2, --densify.max-anchors, less "
            "--jobs",
            highlight=False,
        )


def _left(plan: RunEstimate, status: RunStatus | None) -> RunEstimate:
    """The estimate without what a run has done; of what trains, in proportion to the iterations."""
    if status is None:
        return plan
    coarse, blocks = _share_left([status.of("coarse")]), _share_left(status.blocks)
    shares = {"stereo": float(coarse == 1), "coarse": coarse, "motion": float(blocks > 0), "blocks": blocks}
    return replace(plan, times={name: cost * shares.get(name, 1.0) for name, cost in plan.times.items()})


def _share_left(stages: Sequence[StageStatus]) -> float:
    """What is left of stages that train, of 1; 1 where there are none yet."""
    left = [1.0 - _progress(stage) for stage in stages]
    return sum(left) / len(left) if left else 1.0


def _progress(stage: StageStatus) -> float:
    if stage.state == "done":
        return 1.0
    told = stage.status if stage.state in ("running", "stopped", "failed") else None
    return told.iteration / told.iterations if told is not None and told.iteration and told.iterations else 0.0
