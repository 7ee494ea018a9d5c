"""`vdgs run --dry-run`: what a run would take, by estimate, before it begins. Nothing is written.

Time is measured, not guessed: a few steps at each size of the photographs, on this machine and with these settings. Of
photographs alone two are searched and matched, and the steps are those of a scene like theirs (`assumed_scene`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import read_reconstruction
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig, block_train_config, resolve_iterations
from vdgs.config.ranges import check_ranges
from vdgs.config.validation_rules import check_config
from vdgs.distributed.resource_allocation import Allocation, ShardWorkload, allocate_local, exceeds_memory
from vdgs.errors import VdgsError
from vdgs.kernels import get_num_threads
from vdgs.partition.partition_scene import choose_block_count
from vdgs.pipeline.assumed_scene import as_many, assumed_capture
from vdgs.pipeline.dense_points import max_dense_points
from vdgs.pipeline.image_size import choose_image_size
from vdgs.pipeline.time_estimate import (
    COARSE_VIEW_STEPS,
    MAP_STEPS,
    MERGED_VIEW_STEPS,
    OTHER_SECONDS,
    START_SECONDS,
    StepTimes,
    expected_growth,
    time_steps,
    time_stereo,
)
from vdgs.pipeline.train_coarse import build_coarse_problem, initial_coarse_state
from vdgs.rendering.ortho.map_status import has_ortho_dependencies
from vdgs.runs.config_file import changed_flags
from vdgs.runs.create_or_resume import capture_options_changed, run_settings
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStatus, get_run_status
from vdgs.sfm.reconstruction_plan import plan_reconstruction, print_plan
from vdgs.sfm.run_request import is_image_input, make_sfm_request
from vdgs.sfm.sfm_estimate import estimate_sfm
from vdgs.system.atomic_files import read_json
from vdgs.system.memory.memory_estimate import block_workload, decoded_image_bytes, estimate_memory, max_image_pixels
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.processor_time import NO_COST, Cost, describe_cost
from vdgs.system.units import data_size, rough_duration
from vdgs.training.session.memory_advice import training_workload
from vdgs.training.session.trainer import image_cache_bytes

START = Cost(START_SECONDS, START_SECONDS)


@dataclass(frozen=True, kw_only=True)
class RunEstimate:
    """What a run takes by estimate."""

    anchors: int
    dense_points: int
    """The most that stereo may add to the sparse points; an anchor starts at each."""
    blocks: int
    coarse_iterations: int
    block_iterations: int
    """Of one block, where all have equally many images and no step draws a crop."""
    jobs: int
    free_bytes: int
    coarse_bytes: int
    block_bytes: int
    images_bytes: int
    """Of one block, beside `block_bytes`."""
    may_exceed_memory: bool
    growth: tuple[float, float]
    """How many times their number anchors become in the coarse stage, and in a block."""
    times: Mapping[str, Cost]
    """What each stage takes: photographs, stereo, coarse, blocks, measuring, maps, other."""
    slowdown: float
    """How many times as long it takes as busy as the machine is now."""

    @property
    def total(self) -> Cost:
        return sum(self.times.values(), NO_COST)


@dataclass(frozen=True)
class _Scene:
    """What is to be trained: a capture, or one that stands for the photographs of which one will be made."""

    timed: Capture
    """Whose steps are timed."""
    counted: Capture
    """Whose photographs are counted."""
    test_views: int
    points: int
    views_per_point: float = 8.0
    """By how many photographs a place is seen."""


def estimate_run(request: RunRequest, console: Console) -> RunEstimate:
    """Print what `vdgs run` would do and take.

    Raises what reading the capture or the photographs raises, VdgsError for bad settings.
    """
    check_ranges(request)
    method = request.method()
    check_config(method)
    if request.options.undistort:
        raise VdgsError("--dry-run writes nothing, and --undistort writes photographs: leave one of the two out.")
    if is_image_input(request):
        return _estimate_from_images(request, console)
    request = choose_image_size(request, console)
    capture = load_capture(request.capture, request.options)
    for warning in capture.warnings:
        console.print(f"[yellow]note[/] {warning}", highlight=False)
    method = replace(method, training=resolve_iterations(method.training, len(capture.train_views)))
    status = _run_status(request, capture, method, console)
    estimate = _estimate(_Scene(capture, capture, len(capture.test_views), len(capture.points)), method, request)
    _print_estimate(estimate, method, status, console)
    return estimate


def _estimate_from_images(run_request: RunRequest, console: Console) -> RunEstimate:
    """The whole job of photographs alone; of a capture that was made of them before, what remains."""
    request = make_sfm_request(run_request)
    if read_reconstruction(request.output) is not None:
        options = replace(run_request.options, gps=None)
        with_capture = replace(run_request, capture=request.output, extra_image_folders=(), options=options)
        return estimate_run(with_capture, console)
    plan = plan_reconstruction(request)
    sfm = estimate_sfm(plan)
    print_plan(plan, sfm.text(plan.threads), console)
    count = len(plan.image_list.images)
    tested = -(-count // run_request.options.test_every)
    method = run_request.method()
    method = replace(method, training=resolve_iterations(method.training, count - tested))
    with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
        timed = assumed_capture(plan, run_request.options, sfm.points, Path(folder))
        scene = _Scene(timed, as_many(timed, count - tested), tested, sfm.points)
        if plan.preflight.views_per_point:
            scene = replace(scene, views_per_point=plan.preflight.views_per_point)
        estimate = _estimate(scene, method, run_request)
    slowdown = max(sfm.slowdown, estimate.slowdown)
    estimate = replace(estimate, times={"photographs": sfm.total, **estimate.times}, slowdown=slowdown)
    _print_estimate(estimate, method, None, console)
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
    return get_run_status(run, settings)


def _estimate(scene: _Scene, method: MethodConfig, request: RunRequest) -> RunEstimate:
    config, views = method.training, len(scene.counted.train_views)
    factors = sorted({factor for _, factor in (*config.resolution_schedule, *method.block.resolution_schedule)})
    budget = image_cache_bytes(request.checkpointing)
    with ImageCache(scene.timed.train_views, budget, downscales=tuple({1, *factors})) as images:
        stage, anchors = build_coarse_problem(scene.timed, config, images, request.device)
        sparse = training_workload(initial_coarse_state(anchors, stage, config.exposure_compensation), stage)
        steps = time_steps(stage, anchors, images, factors, config.exposure_compensation)
        dense = _dense_room(scene) if config.anchors.mvs else 0
        stereo = views * time_stereo(scene.timed, images, config.anchors) if dense else 0.0
    share = scene.points / max(1, len(scene.timed.points))
    sparse = replace(sparse, anchors=round(share * sparse.anchors))
    need = replace(sparse, anchors=sparse.anchors + dense)
    cameras, free = [view.camera for view in scene.counted.train_views], available_memory_bytes()
    pixels = max_image_pixels(cameras, method.block.resolution_schedule)
    blocks = choose_block_count(need.max_grown_anchors, views, pixels, method)
    largest = block_workload(method, -(-need.max_grown_anchors // blocks), need.max_grown_anchors, pixels)
    block_bytes, coarse_bytes = estimate_memory(largest).total, estimate_memory(need).total
    image_bytes, image_gb = decoded_image_bytes(cameras), request.checkpointing.image_cache_gb
    work = ShardWorkload(
        shards=blocks, shard_bytes=block_bytes, jobs=request.jobs, image_gb=image_gb, images_bytes=image_bytes
    )
    local = allocate_local(work, get_num_threads(), free)
    block = block_train_config(method, max(1, round(views * min(1.0, 1.5 / blocks))))
    more = 1 + dense / max(sparse.anchors, 1) / 2  # stereo fills half of what it may, where it fills any
    start = more * expected_growth(config, steps.texture)
    times = {
        "stereo": Cost(stereo / get_num_threads(), stereo),
        "coarse": steps.stage(config, more),
        "blocks": _side_by_side((steps.stage(block, start) + START) * blocks, local),
        **_other_times(scene, steps, bool(request.ortho)),
    }
    return RunEstimate(
        anchors=sparse.anchors,
        dense_points=dense,
        blocks=blocks,
        coarse_iterations=config.iterations,
        block_iterations=block.iterations,
        jobs=local.max_concurrent,
        free_bytes=free,
        coarse_bytes=coarse_bytes,
        block_bytes=block_bytes,
        images_bytes=min(image_bytes, round(1e9 * local.image_gb)),
        may_exceed_memory=coarse_bytes > free or exceeds_memory(work, local.max_concurrent, free),
        growth=(expected_growth(config, steps.texture), expected_growth(block, steps.texture)),
        times=times,
        slowdown=steps.slowdown,
    )


def _dense_room(scene: _Scene) -> int:
    """The most points that stereo may add to those that there are, or will be."""
    return max(0, max_dense_points(scene.counted) + len(scene.counted.points) - scene.points)


def _side_by_side(cost: Cost, allocation: Allocation) -> Cost:
    """Blocks that are trained at once share the processors better than the threads of one do."""
    if allocation.max_concurrent == 1:
        return cost
    return Cost(cost.processor_seconds / get_num_threads(), cost.processor_seconds)


def _other_times(scene: _Scene, steps: StepTimes, ortho: bool) -> dict[str, Cost]:
    """What is drawn and measured, by what steps take, and the rest."""
    step, views = steps.at_full_size, len(scene.counted.train_views) + scene.test_views
    maps = MAP_STEPS * views / scene.views_per_point if ortho and has_ortho_dependencies() else 0.0
    return {
        "measuring": step * (scene.test_views * (COARSE_VIEW_STEPS + MERGED_VIEW_STEPS)),
        "maps": step * maps,
        "other": Cost(OTHER_SECONDS, OTHER_SECONDS),
    }


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
        f"{blocks}{chosen}: about {plan.block_iterations:,} iterations each, {plan.jobs} at once, at most "
        f"{data_size(plan.block_bytes)} each and {data_size(plan.images_bytes)} for photographs, about "
        f"{takes('blocks')}{done(*names)}",
        f"measuring, maps, report: about {takes('measuring', 'maps', 'other')}",
        f"memory that is free: {data_size(plan.free_bytes)}",
        f"the whole job: {describe_cost(plan.total, get_num_threads(), plan.slowdown)}",
        f"Measured now on this machine: training steps at each size{', stereo' if plan.dense_points else ''}"
        f"{', features and matches of two photographs' if 'photographs' in plan.times else ''}. Anchors are taken to "
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
