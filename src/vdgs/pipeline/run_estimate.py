"""What a run takes at each size of its photographs, by one probe: time and memory, before it begins.

Steps are timed at one size; those of the others follow, for a step takes so much for its anchors and calls and so much
for each pixel (`StepTimes`). The choice of a size and `vdgs run --dry-run` have the same figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from vdgs.captures.capture import Capture
from vdgs.captures.image_cache import ImageCache
from vdgs.config.commands import RunRequest
from vdgs.config.method import MethodConfig, TrainConfig, block_train_config
from vdgs.distributed.resource_allocation import (
    Allocation,
    MachineResources,
    ShardWorkload,
    allocate_local,
    exceeds_memory,
)
from vdgs.evaluation.moving_pixels import MAX_OTHERS, SAMPLED_PHOTOGRAPHS
from vdgs.geometry.camera import Camera
from vdgs.kernels import get_num_threads
from vdgs.kernels.device_selection import cards_of
from vdgs.model.initialization.initialize import initialize_anchors
from vdgs.model.levels import fit_levels
from vdgs.partition.partition_scene import choose_block_count
from vdgs.pipeline.dense_points import PIXELS_PER_POINT
from vdgs.pipeline.time_estimate import (
    COARSE_VIEW_STEPS,
    MAP_STEPS,
    MERGED_VIEW_STEPS,
    MOTION_VIEW_SECONDS,
    MOTION_VIEW_STEPS,
    OTHER_SECONDS,
    SMALL_FACTOR,
    START_SECONDS,
    Growth,
    StepTimes,
    crowd,
    mean_growth,
    measure_textures,
    probed_views,
    time_steps,
    time_stereo,
)
from vdgs.pipeline.train_coarse import build_coarse_problem, initial_coarse_state
from vdgs.rendering.ortho.map_status import has_ortho_dependencies
from vdgs.system.memory.memory_estimate import (
    TrainingWorkload,
    block_workload,
    decoded_image_bytes,
    estimate_memory,
    max_image_pixels,
)
from vdgs.system.memory.process_memory import available_memory_bytes
from vdgs.system.processor_time import NO_COST, Cost, describe_cost
from vdgs.training.session.memory_advice import training_workload
from vdgs.training.session.trainer import image_cache_bytes

START = Cost(START_SECONDS, START_SECONDS)
#: Steps are timed at the largest size of so many pixels at most.
MAX_PROBED_PIXELS = 700_000
#: Share of the points that stereo may add which it finds, where it finds any.
STEREO_SHARE = 0.5
#: How many times as many anchors levels of them make, and how many times as long training takes then (measured).
LEVELS_ANCHORS, LEVELS_TIME = 1.7, 1.1


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
    """What each stage takes: photographs, stereo, coarse, motion, blocks, measuring, maps, other."""
    slowdown: float
    """How many times as long it takes as busy as the machine is now."""

    @property
    def total(self) -> Cost:
        return sum(self.times.values(), NO_COST)

    def text(self) -> str:
        """How long it takes."""
        return describe_cost(self.total, get_num_threads(), self.slowdown)


@dataclass(frozen=True)
class Scene:
    """What is to be trained: a capture, or one that stands for the photographs of which one will be made."""

    timed: Capture
    """Whose steps are timed."""
    cameras: Sequence[Camera]
    """Of all training photographs, at the largest size that may be used."""
    test_views: int
    points: int
    views_per_point: float = 8.0
    """By how many photographs a place is seen."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What was measured of a scene."""

    steps: StepTimes
    textures: Mapping[float, float]
    """At each size, by how much its sides are shrunk from the cameras of the scene."""
    stereo: float
    """Processor seconds of the stereo of a photograph."""
    workload: TrainingWorkload
    """Of the coarse stage, from the sparse points alone."""
    has_levels: bool = False
    """Whether anchors have levels."""


def probe(scene: Scene, method: MethodConfig, request: RunRequest, factors: Sequence[float]) -> Probe:
    """Time steps at one of the sizes, and measure what differs from size to size: seconds."""
    config, capture = method.training, scene.timed
    first = capture.train_views[0].camera
    pixels = first.width * first.height
    at = next((each for each in sorted(factors) if pixels / each**2 <= MAX_PROBED_PIXELS), max(factors))
    views = [replace(view, camera=_shrunk([view.camera], at)[0]) for view in probed_views(capture.train_views)]
    budget = image_cache_bytes(request.checkpointing)
    one_size = replace(config, resolution_schedule=((0.0, SMALL_FACTOR),))
    cameras = [view.camera for view in capture.train_views]
    textures = measure_textures(capture.train_views, factors)
    with ImageCache(views, budget, downscales=(1, SMALL_FACTOR)) as images:
        stage, _ = build_coarse_problem(replace(capture, views=tuple(views)), one_size, images, request.device)
        begun = (capture.points, capture.point_colors, cameras, config.init, config.model.num_offsets)
        anchors, voxel = initialize_anchors(*begun)
        workload = training_workload(initial_coarse_state(anchors, stage, config.exposure_compensation), stage)
        growth = _growth(scene, workload, config, at, textures[at])
        grown = growth.more * mean_growth(config, growth.coarse(config))
        extra = crowd(capture, grown, voxel)
        anchors, _ = initialize_anchors(*begun, extra)
        steps = time_steps(stage, anchors, config.exposure_compensation)
    stereo = 0.0
    if _dense_room(scene, config, min(factors)):
        with ImageCache(capture.train_views, budget) as images:
            stereo = time_stereo(capture, images, config.init)
    levels = fit_levels(scene.timed.points, scene.cameras, config.model.levels)
    return Probe(steps=steps, textures=textures, stereo=stereo, workload=workload, has_levels=bool(levels))


def _growth(
    scene: Scene, workload: TrainingWorkload, config: TrainConfig, factor: float, texture: float
) -> Growth:  # fmt: skip
    sparse = max(1.0, workload.anchors * scene.points / max(1, len(scene.timed.points)))
    more = 1 + _dense_room(scene, config, factor) * STEREO_SHARE / sparse
    camera = _shrunk(scene.cameras[:1], factor)[0]
    room = camera.width * camera.height / max(1.0, workload.seen * sparse * more)
    return Growth(texture=texture, more=more, room=room)


def estimate_at(scene: Scene, probed: Probe, method: MethodConfig, request: RunRequest, factor: float) -> RunEstimate:
    """What the run takes with photographs whose sides are shrunk by `factor` from the cameras of the scene."""
    config, views, steps = method.training, len(scene.cameras), probed.steps
    cameras, texture = _shrunk(scene.cameras, factor), probed.textures[factor]
    growth = _growth(scene, probed.workload, config, factor, texture)
    dense = _dense_room(scene, config, factor)
    more, longer = (LEVELS_ANCHORS, LEVELS_TIME) if probed.has_levels else (1.0, 1.0)
    stereo = views * probed.stereo if dense else 0.0
    share = scene.points / max(1, len(scene.timed.points))
    images_bytes = decoded_image_bytes(cameras)
    sparse = replace(
        probed.workload,
        anchors=round(share * more * probed.workload.anchors),
        pixels=max_image_pixels(cameras, config.resolution_schedule),
        image_cache_bytes=min(images_bytes, image_cache_bytes(request.checkpointing)),
    )
    need = replace(sparse, anchors=sparse.anchors + round(more * dense))
    free = available_memory_bytes()
    pixels = max_image_pixels(cameras, method.block.resolution_schedule)
    blocks = choose_block_count(need.max_grown_anchors, views, pixels, method)
    largest = block_workload(method, -(-need.max_grown_anchors // blocks), need.max_grown_anchors, pixels)
    block_bytes, coarse_bytes = estimate_memory(largest).total, estimate_memory(need).total
    work = ShardWorkload(
        shards=blocks, shard_bytes=block_bytes, jobs=request.jobs, image_gb=request.checkpointing.image_cache_gb,
        images_bytes=images_bytes,
    )  # fmt: skip
    is_local = request.executor_options.executor == "local"  # jobs of Ray and SLURM run on cards of other machines
    cards = tuple(cards_of(request.device).values()) if is_local else ()
    local = allocate_local(work, MachineResources(get_num_threads(), free, cards))
    block = block_train_config(method, max(1, round(views * min(1.0, 1.5 / blocks))))
    drawn = cameras[0].width * cameras[0].height
    coarse_growth, block_growth = growth.coarse(config), growth.block(config, block)
    start = probed.workload.anchors * growth.more  # of the scene whose steps were timed
    grown = start * coarse_growth
    block_steps = steps.stage(block, drawn, grown, block_growth) * longer
    times = {
        "stereo": Cost(stereo / get_num_threads(), stereo),
        "coarse": steps.stage(config, drawn, start, coarse_growth) * longer,
        "blocks": _side_by_side((block_steps + START) * blocks, local),
        **_other_times(scene, steps.step(drawn, grown), request, method.block.mask_moving),
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
        images_bytes=min(images_bytes, round(1e9 * local.image_gb)),
        may_exceed_memory=coarse_bytes > free or exceeds_memory(work, local.max_concurrent, free),
        growth=(coarse_growth, block_growth),
        times=times,
        slowdown=steps.slowdown,
    )


def _shrunk(cameras: Sequence[Camera], factor: float) -> list[Camera]:
    return [
        camera.resized(max(1, int(camera.width / factor)), max(1, int(camera.height / factor))) for camera in cameras
    ]


def _dense_room(scene: Scene, config: TrainConfig, factor: float) -> int:
    """The most points that stereo may add to those that there are, or will be."""
    if not config.init.mvs:
        return 0
    pixels = sum(camera.width * camera.height for camera in _shrunk(scene.cameras, factor))
    return max(0, pixels // PIXELS_PER_POINT - scene.points)


def _side_by_side(cost: Cost, allocation: Allocation) -> Cost:
    """Blocks that are trained at once share the processors better than the threads of one do."""
    if allocation.max_concurrent == 1:
        return cost
    return Cost(cost.processor_seconds / get_num_threads(), cost.processor_seconds)


def _other_times(scene: Scene, step: Cost, request: RunRequest, mask_moving: str) -> dict[str, Cost]:
    """What is drawn and measured, by what steps take, and the rest. Where `mask_moving` is `auto` masks may come on
    top of the sample that is compared."""
    views = len(scene.cameras) + scene.test_views
    maps = MAP_STEPS * views / scene.views_per_point if request.ortho and has_ortho_dependencies() else 0.0
    compared = {"on": len(scene.cameras), "auto": min(SAMPLED_PHOTOGRAPHS, len(scene.cameras)), "off": 0}[mask_moving]
    drawn, comparing = min(len(scene.cameras), (MAX_OTHERS + 1) * compared), MOTION_VIEW_SECONDS * compared
    return {
        "motion": step * (MOTION_VIEW_STEPS * drawn) + Cost(comparing, comparing),
        "measuring": step * (scene.test_views * (COARSE_VIEW_STEPS + MERGED_VIEW_STEPS)),
        "maps": step * maps,
        "other": Cost(OTHER_SECONDS, OTHER_SECONDS),
    }
