"""How long the stages of a run take, from steps and a photograph's stereo that are timed now on this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from vdgs.captures.capture import Capture, View
from vdgs.captures.image_cache import ImageCache
from vdgs.captures.image_files import decode_image
from vdgs.config.method import InitConfig, TrainConfig
from vdgs.errors import Stopped, VdgsError
from vdgs.model.anchors import Anchors
from vdgs.model.initialization.stereo import StereoInputs, compute_dense_points
from vdgs.pipeline.dense_points import fusion_cell
from vdgs.pipeline.train_coarse import initial_coarse_state
from vdgs.system.memory.memory_estimate import MAX_GROWTH, max_growth_factor
from vdgs.system.processor_time import NO_COST, Cost, Moment
from vdgs.system.stop_signals import check_stop_requested
from vdgs.training import TrainingProblem, train

#: Steps at each size that are timed at least, the first of them not; then as many as fit into so many seconds.
MIN_TIMED_STEPS, MAX_TIMED_SECONDS = 8, 1.5
#: What anchors gain where growth decides often, as a share of their number, in photographs of `USUAL_TEXTURE`, with the
#: square of the texture; how many times as many they become in blocks whose growth is compensated below a fixed T_low;
#: and after how many decisions half of that is reached. Measured (`laptop`, texture): 1.4 times at 13, 1.7 and 1.9 at
#: 17 and 16, 4.6 at 34; 1.8 and 2.3 times at 17 with 100 000 iterations; compensated blocks 6 and 12 times.
PLAIN_GAIN, USUAL_TEXTURE, COMPENSATED_GROWTH, HALF_GROWTH_DECISIONS = 1.3, 17.0, 9.0, 8
#: Photographs whose steps are timed and whose texture is measured; by how much the sides of small ones are shrunk.
PROBED_VIEWS, SMALL_FACTOR = 6, 4
#: Textures beyond these tell no more.
TEXTURE_RANGE = (8.0, 36.0)
#: Steps are timed with at most so many times as many anchors as sparse points make; how far those that are added lie
#: from them, in voxels.
MAX_CROWDING, CROWD_SPREAD = 20.0, 3.0
#: Of finding what moves: drawing a training photograph and its depth, in steps, and comparing it with twenty others
#: (measured: 0.02 to 0.05 s and 0.1 to 0.4 s at 320 to 407 pixels of width), in processor seconds.
MOTION_VIEW_STEPS, MOTION_VIEW_SECONDS = 0.7, 0.3
#: Time that pseudo views (`loss.pseudo_views`) add to the steps of a stage, as a share (measured).
PSEUDO_VIEWS_SHARE = 0.16
#: Share of a photograph's stereo that confirming its depths adds to finding them.
CONFIRMING = 0.15
#: What measuring a view takes, in training steps of its size: of the coarse model, and of the merged one with its
#: seams; and drawing as many pixels of a map. In processor seconds, starting the process of a block, and all else:
#: reading, cutting, merging, writing the report.
COARSE_VIEW_STEPS, MERGED_VIEW_STEPS, MAP_STEPS, START_SECONDS, OTHER_SECONDS = 8.0, 14.0, 4.0, 5.0, 10.0


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """What a training step takes: some for its calls, and as much again for each pixel and for each anchor.

    The two add up: anchors that grow become smaller, so that a pixel shows about as many of them as before.
    """

    fixed: Cost
    per_pixel: Cost
    per_anchor: Cost
    slowdown: float

    def step(self, pixels: float, anchors: float) -> Cost:
        """A step of a photograph of so many pixels, with so many anchors in the scene."""
        return self.fixed + self.per_pixel * pixels + self.per_anchor * anchors

    def stage(self, config: TrainConfig, pixels: int, anchors: float, growth: float) -> Cost:
        """All steps of a stage, each at the size that the schedule gives it, with anchors that grow from so many."""
        ends = [begin for begin, _ in config.resolution_schedule[1:]] + [1.0]
        mean = anchors * mean_growth(config, growth)
        total = NO_COST
        for (begin, factor), end in zip(config.resolution_schedule, ends, strict=True):
            total += self.step(pixels / factor**2, mean) * (config.iterations * max(0.0, end - begin))
        return total * (1 + PSEUDO_VIEWS_SHARE) if config.loss.pseudo_views else total


@dataclass(frozen=True, kw_only=True)
class Growth:
    """How anchors become more by estimate, of a coarse model and then of its blocks."""

    texture: float
    """Of the photographs."""
    more: float
    """How many times the anchors of the sparse points the coarse model begins with: growth adds to the sparse ones."""
    room: float
    """How many anchors there is a pixel for, of a photograph, for each that it shows at the start: growth ends where
    each has its pixel."""

    def coarse(self, config: TrainConfig) -> float:
        """How many times their number the anchors become in the coarse stage."""
        return self._after(_decisions(config)) if config.densify.num_levels else 1.0

    def block(self, coarse: TrainConfig, config: TrainConfig) -> float:
        """The same in a block, which goes on where the coarse stage ended unless its compensation grows far more."""
        decisions = _decisions(config)
        if not config.densify.num_levels:
            return 1.0
        if max_growth_factor(config.compensation) != MAX_GROWTH:
            return 1 + (COMPENSATED_GROWTH - 1) * _progress(decisions)
        before = _decisions(coarse)
        return self._after(before + decisions) / self._after(before)

    def _after(self, decisions: float) -> float:
        gain = PLAIN_GAIN * (float(np.clip(self.texture, *TEXTURE_RANGE)) / USUAL_TEXTURE) ** 2
        return 1 + min(gain * _progress(decisions) / self.more, max(0.0, self.room - 1))


def _decisions(config: TrainConfig) -> float:
    densify = config.densify
    return max(0.0, (densify.stop_fraction * config.iterations - densify.start) / densify.every)


def _progress(decisions: float) -> float:
    return decisions / (decisions + HALF_GROWTH_DECISIONS)


def mean_growth(config: TrainConfig, growth: float) -> float:
    """The mean over the steps of a stage: anchors grow from the first decision to the last."""
    first = min(1.0, config.densify.start / max(1, config.iterations))
    middle = (first + max(first, config.densify.stop_fraction)) / 2
    return 1 + (growth - 1) * (1 - middle)


def measure_textures(views: Sequence[View], factors: Sequence[float]) -> dict[float, float]:
    """Mean absolute Laplacian of photographs, shrunk from the size of their cameras by each factor, in gray levels."""
    found: dict[float, list[float]] = {factor: [] for factor in factors}
    for view in probed_views(views):
        whole = cv2.cvtColor(decode_image(view.image_path)[0], cv2.COLOR_RGB2GRAY)
        for factor in factors:
            size = (max(1, int(view.camera.width / factor)), max(1, int(view.camera.height / factor)))
            gray = cv2.resize(whole, size, interpolation=cv2.INTER_AREA).astype(np.float32)
            found[factor].append(float(np.abs(cv2.Laplacian(gray, cv2.CV_32F)).mean()))
    return {factor: float(np.mean(values)) for factor, values in found.items()}


def probed_views(views: Sequence[View]) -> list[View]:
    """A few from all over the capture: so few are decoded before steps are timed, as in training most of them are."""
    return [views[k] for k in np.unique(np.linspace(0, len(views) - 1, PROBED_VIEWS).round().astype(int))]


def crowd(capture: Capture, times: float, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] and colors near those of a capture, with which it has so many times as many anchors."""
    more = max(0, round(min(times, MAX_CROWDING) * len(capture.points)) - len(capture.points))
    rng = np.random.default_rng(0)
    near = rng.integers(0, len(capture.points), more)
    return capture.points[near] + rng.normal(0, CROWD_SPREAD * voxel, (more, 3)), capture.point_colors[near]


def time_steps(stage: TrainingProblem, anchors: Anchors, fit_exposures: bool) -> StepTimes:
    """Train a few steps of whole photographs, of smaller ones, and with half of the anchors.

    The anchors are about as many as the stage will have: a line through those that it begins with would be followed
    too far.
    """
    full, slowdown = _step_cost(stage, anchors, 1, fit_exposures)
    fewer_pixels, _ = _step_cost(stage, anchors, SMALL_FACTOR, fit_exposures)
    half = anchors.select(torch.arange(len(anchors), device="cpu") % 2 == 0)
    fewer_anchors = _step_cost(stage, half, 1, fit_exposures)[0] if len(half) else full
    cameras = [stage.images.camera(0, factor) for factor in (1, SMALL_FACTOR)]
    large, less = (camera.width * camera.height for camera in cameras)
    # What goes with pixels and anchors is shared by the threads as the whole step is.
    clock = full.seconds / max(full.processor_seconds, 1e-9)

    def slope(other: Cost, difference: int, most: float) -> float:
        return min(max(0.0, full.processor_seconds - other.processor_seconds), most) / max(1, difference)

    per_pixel = slope(fewer_pixels, large - less, full.processor_seconds)
    left = full.processor_seconds - per_pixel * large
    per_anchor = slope(fewer_anchors, len(anchors) - len(half), max(0.0, left) / 2)
    return StepTimes(
        fixed=full + Cost(per_pixel * clock, per_pixel) * -large + Cost(per_anchor * clock, per_anchor) * -len(anchors),
        per_pixel=Cost(per_pixel * clock, per_pixel),
        per_anchor=Cost(per_anchor * clock, per_anchor),
        slowdown=slowdown,
    )


def _step_cost(stage: TrainingProblem, anchors: Anchors, factor: int, fit_exposures: bool) -> tuple[Cost, float]:
    """Mean of the steps that are tried, without the first, which opens files; and how busy the machine was."""
    at_size = replace(stage, config=replace(stage.config, resolution_schedule=((0.0, factor),)))
    for view in range(stage.num_images):
        stage.images.get(view, factor)  # most steps of a stage find their photograph decoded
    moments = [Moment.now()]

    def enough() -> bool:
        check_stop_requested()
        return len(moments) > MIN_TIMED_STEPS and moments[-1].clock - moments[1].clock > MAX_TIMED_SECONDS

    state = initial_coarse_state(anchors, at_size, fit_exposures)
    train(state, at_size, stop=enough, after_step=lambda *_: moments.append(Moment.now()))
    first = moments[1] if len(moments) > 2 else moments[0]
    steps = max(1, len(moments) - 2)
    return moments[-1].cost_since(first) * (1 / steps), moments[-1].slowdown_since(first)


class _Enough(Exception):
    """The first photograph is matched."""


def time_stereo(capture: Capture, images: ImageCache, config: InitConfig) -> float:
    """Processor seconds of the stereo of one photograph, which is matched at one size however large it is; 0 where none
    can be matched."""
    cameras = [view.camera for view in capture.train_views]

    def read(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        return images.get(index).image.numpy(), None

    moments = [Moment.now()]

    def stop(_done: int, _total: int) -> None:
        moments.append(Moment.now())  # before the next photograph, which is begun, is matched
        check_stop_requested()
        raise _Enough

    inputs = StereoInputs(cameras, capture.points, capture.points, read)
    try:
        with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
            compute_dense_points(inputs, fusion_cell(capture, config), Path(folder), stop)
    except Stopped:
        raise
    except (_Enough, VdgsError):
        pass  # what stereo cannot do is a matter of the run; the time until then counts
    return moments[-1].cost_since(moments[0]).processor_seconds * (1 + CONFIRMING)
