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
from vdgs.captures.capture_metadata import refuse_another_capture
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.loading import load_capture
from vdgs.captures.reconstruction import read_reconstruction
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig, TrainConfig, block_training, with_iterations
from vdgs.config.ranges import refuse
from vdgs.config.validation_rules import validate
from vdgs.distributed.resource_allocation import Work, exceeds, on_this_machine
from vdgs.errors import VdgsError
from vdgs.kernels import threads as threads_available
from vdgs.partition.partition_scene import choose_block_count
from vdgs.pipeline.dense_points import room_for_points
from vdgs.pipeline.train_coarse import open_stage, start
from vdgs.runs.config_file import changed_options
from vdgs.runs.create_or_resume import reads_otherwise, run_settings
from vdgs.runs.run_folder import RunFolder
from vdgs.runs.run_status import RunStanding, standing_of
from vdgs.sfm.reconstruction_plan import prepare, tell
from vdgs.sfm.run_request import of_photographs, sfm_request
from vdgs.system.atomic_files import read_json
from vdgs.system.memory.memory_estimate import GROWTH, decoded_bytes, estimate, largest_picture, need_of_block
from vdgs.system.memory.process_memory import available_bytes
from vdgs.system.stop_signals import stop_if_asked
from vdgs.system.units import data_size, rough_duration
from vdgs.training import TrainingState, train
from vdgs.training.session.memory_advice import need_of
from vdgs.training.session.trainer import image_budget

#: Steps at each size that are timed at least, the first of them not; then as many as fit into so many seconds.
TIMED_STEPS, TIMED_SECONDS = 4, 2.0


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a run takes by estimate. Seconds are pairs: anchors as many as at the start, and, with all that stereo may
    add, grown all the while."""

    anchors: int
    dense_points: int
    """What stereo may add to the sparse points at most; an anchor starts at each."""
    blocks: int
    coarse_iterations: int
    block_iterations: int
    """Of one block, where all have equally many photographs and no step draws a part."""
    jobs: int
    free_bytes: int
    coarse_bytes: int
    block_bytes: int
    photographs_bytes: int
    """Of one block, beside `block_bytes`."""
    is_short: bool
    """Whether it may take more than is free."""
    coarse_seconds: tuple[float, float]
    blocks_seconds: tuple[float, float]


def plan_run(asked: RunRequest, console: Console) -> Plan | None:
    """Say what `vdgs run` would do and take; None of photographs alone, whose training nobody knows.

    Raises what reading the capture raises, VdgsError for bad settings.
    """
    refuse(asked)
    method = asked.method()
    if problems := validate(method):
        raise VdgsError("These settings do not work:\n  " + "\n  ".join(problems))
    if asked.options.undistort:
        raise VdgsError("--dry-run writes nothing, and --undistort writes photographs: leave one of the two out.")
    if of_photographs(asked):
        return _plan_photographs(asked, console)
    capture = load_capture(asked.capture, asked.options)
    for warning in capture.warnings:
        console.print(f"[yellow]note[/] {warning}", highlight=False)
    method = replace(method, training=with_iterations(method.training, len(capture.train_views)))
    standing = _standing(asked, capture, method, console)
    plan = _plan(capture, method, asked)
    _say(plan, method, standing, console)
    return plan


def _plan_photographs(asked: RunRequest, console: Console) -> Plan | None:
    """The look at photographs; training can be estimated once they are a capture, which a run makes first."""
    request = sfm_request(asked)
    finished = read_reconstruction(request.output)
    if finished is not None:
        return plan_run(
            replace(asked, capture=request.output, photographs=(), options=replace(asked.options, gps=None)), console
        )
    tell(prepare(request), console)
    folders = " ".join(map(str, (asked.capture, *asked.photographs)))
    console.print(
        f"Training can be estimated once they are a capture: vdgs sfm {folders} --output CAPTURE, then the same "
        "with CAPTURE. Nothing was written.",
        highlight=False,
    )
    return None


def _standing(asked: RunRequest, capture: Capture, method: MethodConfig, console: Console) -> RunStanding | None:
    """How far the run is that is there already, with the settings that are asked for; None where there is none."""
    run = RunFolder(asked.output)
    if not run.config_file.exists():
        return None
    settings = run_settings(asked.capture, asked.options, method)
    if run.capture_file.exists() and not reads_otherwise(run, settings):
        refuse_another_capture(run.capture_file, read_json(run.capture_file), capture)
    for line in changed_options(run.settings(), settings):
        console.print(f"[yellow]changed[/] {line}", highlight=False)
    return standing_of(run, settings)


def _plan(capture: Capture, method: MethodConfig, asked: RunRequest) -> Plan:
    config, views = method.training, len(capture.train_views)
    factors = sorted({factor for _, factor in (*config.resolutions, *method.block.resolutions)})
    with ImageCache(capture.train_views, image_budget(asked.watching), downscales=tuple(factors)) as images:
        stage, anchors = open_stage(capture, config, images, asked.device)
        alone = need_of(start(anchors, stage, config.exposure), stage)
        timed = {}
        for factor in factors:
            at_size = replace(stage, config=replace(config, resolutions=((0.0, factor),)))
            timed[factor] = _seconds_a_step(start(anchors, at_size, config.exposure), at_size)
    dense = room_for_points(capture) if config.anchors.stereo else 0
    need, more = replace(alone, anchors=alone.anchors + dense), GROWTH * (1 + dense / max(alone.anchors, 1))
    cameras, free = [view.camera for view in capture.train_views], available_bytes()
    pixels = largest_picture(cameras, method.block.resolutions)
    blocks = choose_block_count(need.grown, views, pixels, method)
    each = estimate(need_of_block(method, -(-need.grown // blocks), need.grown, pixels)).total
    whole = estimate(need).total
    photographs = decoded_bytes(cameras)
    work = Work(
        pieces=blocks,
        piece_bytes=each,
        jobs=asked.jobs,
        image_gb=asked.watching.image_memory_gb,
        photographs_bytes=photographs,
    )
    share = on_this_machine(work, threads_available(), free)
    block = block_training(method, max(1, round(views * min(1.0, 1.5 / blocks))))
    coarse = _seconds(config, timed)
    return Plan(
        anchors=len(anchors), dense_points=dense, blocks=blocks, coarse_iterations=config.iterations,
        block_iterations=block.iterations, jobs=share.at_once, free_bytes=free, coarse_bytes=whole, block_bytes=each,
        photographs_bytes=min(photographs, round(1e9 * share.image_gb)),
        is_short=whole > free or exceeds(work, share.at_once, free), coarse_seconds=(coarse, coarse * (1 + more) / 2),
        blocks_seconds=(blocks * _seconds(block, timed), blocks * _seconds(block, timed) * more),
    )  # fmt: skip


def _seconds_a_step(state: TrainingState, stage: object) -> float:
    """Mean time of the steps that are tried; the first is left out, which opens files and compiles nothing twice."""
    began = [time.monotonic()]

    def enough() -> bool:
        stop_if_asked()
        return len(began) > TIMED_STEPS and began[-1] - began[1] > TIMED_SECONDS

    train(state, stage, stop=enough, after_step=lambda *_: began.append(time.monotonic()))  # type: ignore[arg-type]
    return (began[-1] - began[1]) / (len(began) - 2) if len(began) > 2 else began[-1] - began[0]


def _seconds(config: TrainConfig, timed: dict[int, float]) -> float:
    """Of all steps of a stage, each at the size that the schedule gives it."""
    ends = [begin for begin, _ in config.resolutions[1:]] + [1.0]
    return sum(
        config.iterations * max(0.0, end - begin) * timed[factor]
        for (begin, factor), end in zip(config.resolutions, ends, strict=True)
    )


def _say(plan: Plan, method: MethodConfig, standing: RunStanding | None, console: Console) -> None:
    def done(*names: str) -> str:
        found = [stage for stage in standing.stages if stage.name in names] if standing is not None else []
        whole = bool(found) and all(stage.state == "done" for stage in found)
        return "; done already" if whole else ""

    blocks = f"{plan.blocks} block{'' if plan.blocks == 1 else 's'}"
    auto = method.partition.blocks == "auto"
    chosen = " by estimate: --blocks auto counts again when anchors have grown" if auto else ""
    per_block = _times(plan.blocks_seconds)
    stereo = f" (and at most {plan.dense_points:,} where stereo finds ground)" if plan.dense_points else ""
    names = [stage.name for stage in standing.blocks] if standing is not None else []
    lines = [
        f"coarse model: {plan.anchors:,} anchors at the start{stereo}, {plan.coarse_iterations:,} iterations, at most "
        f"{data_size(plan.coarse_bytes)}, {_times(plan.coarse_seconds)}{done('coarse')}",
        f"{blocks}{chosen}: about {plan.block_iterations:,} iterations each, {plan.jobs} at once, at most "
        f"{data_size(plan.block_bytes)} each and {data_size(plan.photographs_bytes)} for photographs, "
        f"{per_block}{done(*names)}",
        f"memory that is free: {data_size(plan.free_bytes)}",
        "Times are of training alone, from steps timed now on this machine; the larger one is with "
        f"{GROWTH:g} times as many anchors{', and with those of stereo' if plan.dense_points else ''}. Nothing was "
        "written.",
    ]
    console.print("\n".join(lines), highlight=False)
    if plan.is_short:
        console.print(
            "[yellow]warning[/] it may run out of memory. What helps: --downscale 2, --growth.max-anchors, less --jobs",
            highlight=False,
        )


def _times(seconds: Sequence[float]) -> str:
    low, high = (rough_duration(each) for each in seconds)
    return f"{low} to {high}" if low != high else f"about {low}"
