"""`vdgs run --dry-run`: what a run would take, by estimate, before it begins. Nothing is written.

Time is measured, not guessed: a few steps at each size of the photographs, on this machine and with these settings.
What cannot be known before is how far anchors grow, so times are given as two ends.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rich.console import Console

from vdgs.captures.capture import Capture
from vdgs.captures.capture_metadata import check_same_capture
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import read_reconstruction
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig, TrainConfig, block_train_config, resolve_iterations
from vdgs.config.ranges import check_ranges
from vdgs.config.validation_rules import check_config
from vdgs.distributed.resource_allocation import ShardWorkload, allocate_local, exceeds_memory
from vdgs.errors import VdgsError
from vdgs.kernels import get_num_threads
from vdgs.partition.partition_scene import choose_block_count
from vdgs.pipeline.dense_points import max_dense_points
from vdgs.pipeline.train_coarse import build_coarse_problem, initial_coarse_state
from vdgs.runs.config_file import changed_flags
from vdgs.runs.create_or_resume import capture_options_changed, run_settings
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStatus, get_run_status
from vdgs.sfm.reconstruction_plan import plan_reconstruction, print_plan
from vdgs.sfm.run_request import is_image_input, make_sfm_request
from vdgs.system.atomic_files import read_json
from vdgs.system.memory.memory_estimate import (
    MAX_GROWTH,
    block_workload,
    decoded_image_bytes,
    estimate_memory,
    max_image_pixels,
)
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.quoting import shell_word
from vdgs.system.stop_signals import check_stop_requested
from vdgs.system.units import data_size, rough_duration
from vdgs.training import TrainingProblem, TrainingState, train
from vdgs.training.session.memory_advice import training_workload
from vdgs.training.session.trainer import image_cache_bytes

#: Steps at each size that are timed at least, the first of them not; then as many as fit into so many seconds.
MIN_TIMED_STEPS, MAX_TIMED_SECONDS = 4, 2.0


@dataclass(frozen=True, kw_only=True)
class RunEstimate:
    """What a run takes by estimate. Seconds are pairs: with as many anchors as at the start, and with all that stereo
    may add, grown all the while."""

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
    coarse_seconds: tuple[float, float]
    blocks_seconds: tuple[float, float]


def estimate_run(request: RunRequest, console: Console) -> RunEstimate | None:
    """Print what `vdgs run` would do and take; None of photographs alone, whose training cannot be estimated.

    Raises what reading the capture raises, VdgsError for bad settings.
    """
    check_ranges(request)
    method = request.method()
    check_config(method)
    if request.options.undistort:
        raise VdgsError("--dry-run writes nothing, and --undistort writes photographs: leave one of the two out.")
    if is_image_input(request):
        return _estimate_reconstruction(request, console)
    capture = load_capture(request.capture, request.options)
    for warning in capture.warnings:
        console.print(f"[yellow]note[/] {warning}", highlight=False)
    method = replace(method, training=resolve_iterations(method.training, len(capture.train_views)))
    status = _run_status(request, capture, method, console)
    estimate = _estimate(capture, method, request)
    _print_estimate(estimate, method, status, console)
    return estimate


def _estimate_reconstruction(run_request: RunRequest, console: Console) -> RunEstimate | None:
    """The plan of the reconstruction; training can be estimated once there is a capture, which a run makes first."""
    request = make_sfm_request(run_request)
    if read_reconstruction(request.output) is not None:
        options = replace(run_request.options, gps=None)
        with_capture = replace(run_request, capture=request.output, extra_image_folders=(), options=options)
        return estimate_run(with_capture, console)
    print_plan(plan_reconstruction(request), console)
    folders = " ".join(map(shell_word, (run_request.capture, *run_request.extra_image_folders)))
    console.print(
        f"Training can be estimated once they are a capture: vdgs sfm {folders} --output CAPTURE, then the same "
        "with CAPTURE. Nothing was written.",
        highlight=False,
    )
    return None


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


def _estimate(capture: Capture, method: MethodConfig, request: RunRequest) -> RunEstimate:
    config, views = method.training, len(capture.train_views)
    factors = sorted({factor for _, factor in (*config.resolution_schedule, *method.block.resolution_schedule)})
    with ImageCache(capture.train_views, image_cache_bytes(request.checkpointing), downscales=tuple(factors)) as images:
        stage, anchors = build_coarse_problem(capture, config, images, request.device)
        fit_exposures = config.exposure_compensation
        sparse = training_workload(initial_coarse_state(anchors, stage, fit_exposures), stage)
        timed = {}
        for factor in factors:
            at_size = replace(stage, config=replace(config, resolution_schedule=((0.0, factor),)))
            timed[factor] = _seconds_per_step(initial_coarse_state(anchors, at_size, fit_exposures), at_size)
    dense = max_dense_points(capture) if config.anchors.mvs else 0
    need, growth = replace(sparse, anchors=sparse.anchors + dense), MAX_GROWTH * (1 + dense / max(sparse.anchors, 1))
    cameras, free = [view.camera for view in capture.train_views], available_memory_bytes()
    pixels = max_image_pixels(cameras, method.block.resolution_schedule)
    blocks = choose_block_count(need.max_grown_anchors, views, pixels, method)
    largest = block_workload(method, -(-need.max_grown_anchors // blocks), need.max_grown_anchors, pixels)
    block_bytes, coarse_bytes = estimate_memory(largest).total, estimate_memory(need).total
    image_bytes, image_gb = decoded_image_bytes(cameras), request.checkpointing.image_cache_gb
    work = ShardWorkload(
        shards=blocks, shard_bytes=block_bytes, jobs=request.jobs, image_gb=image_gb, images_bytes=image_bytes
    )
    share = allocate_local(work, get_num_threads(), free)
    block = block_train_config(method, max(1, round(views * min(1.0, 1.5 / blocks))))
    coarse_seconds, blocks_seconds = _seconds(config, timed), blocks * _seconds(block, timed)
    return RunEstimate(
        anchors=len(anchors),
        dense_points=dense,
        blocks=blocks,
        coarse_iterations=config.iterations,
        block_iterations=block.iterations,
        jobs=share.max_concurrent,
        free_bytes=free,
        coarse_bytes=coarse_bytes,
        block_bytes=block_bytes,
        images_bytes=min(image_bytes, round(1e9 * share.image_gb)),
        may_exceed_memory=coarse_bytes > free or exceeds_memory(work, share.max_concurrent, free),
        coarse_seconds=(coarse_seconds, coarse_seconds * (1 + growth) / 2),
        blocks_seconds=(blocks_seconds, blocks_seconds * growth),
    )


def _seconds_per_step(state: TrainingState, stage: TrainingProblem) -> float:
    """Mean time of the steps that are tried, without the first, which opens files."""
    times = [time.monotonic()]

    def enough() -> bool:
        check_stop_requested()
        return len(times) > MIN_TIMED_STEPS and times[-1] - times[1] > MAX_TIMED_SECONDS

    train(state, stage, stop=enough, after_step=lambda *_: times.append(time.monotonic()))
    return (times[-1] - times[1]) / (len(times) - 2) if len(times) > 2 else times[-1] - times[0]


def _seconds(config: TrainConfig, timed: dict[int, float]) -> float:
    """Of all steps of a stage, each at the size that the schedule gives it."""
    ends = [begin for begin, _ in config.resolution_schedule[1:]] + [1.0]
    return sum(
        config.iterations * max(0.0, end - begin) * timed[factor]
        for (begin, factor), end in zip(config.resolution_schedule, ends, strict=True)
    )


def _print_estimate(plan: RunEstimate, method: MethodConfig, status: RunStatus | None, console: Console) -> None:
    def done(*names: str) -> str:
        stages = [stage for stage in status.stages if stage.name in names] if status is not None else []
        return "; done already" if stages and all(stage.state == "done" for stage in stages) else ""

    blocks = f"{plan.blocks} block{'' if plan.blocks == 1 else 's'}"
    auto = method.partition.blocks == "auto"
    chosen = " by estimate: --blocks auto counts again when anchors have grown" if auto else ""
    stereo = f" (and at most {plan.dense_points:,} where stereo finds ground)" if plan.dense_points else ""
    names = [stage.name for stage in status.blocks] if status is not None else []
    lines = [
        f"coarse model: {plan.anchors:,} anchors at the start{stereo}, {plan.coarse_iterations:,} iterations, at most "
        f"{data_size(plan.coarse_bytes)}, {_times(plan.coarse_seconds)}{done('coarse')}",
        f"{blocks}{chosen}: about {plan.block_iterations:,} iterations each, {plan.jobs} at once, at most "
        f"{data_size(plan.block_bytes)} each and {data_size(plan.images_bytes)} for photographs, "
        f"{_times(plan.blocks_seconds)}{done(*names)}",
        f"memory that is free: {data_size(plan.free_bytes)}",
        "Times are of training alone, from steps timed now on this machine; the larger one is with "
        f"{MAX_GROWTH:g} times as many anchors{', and with those of stereo' if plan.dense_points else ''}. Nothing was "
        "written.",
    ]
    console.print("\n".join(lines), highlight=False)
    if plan.may_exceed_memory:
        console.print(
            "[yellow]warning[/] it may run out of memory. What helps: --downscale 2, --densify.max-anchors, less "
            "--jobs",
            highlight=False,
        )


def _times(seconds: Sequence[float]) -> str:
    low, high = (rough_duration(each) for each in seconds)
    return f"{low} to {high}" if low != high else f"about {low}"
