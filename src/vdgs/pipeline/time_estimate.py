"""How long the stages of a run take, from steps and a photograph's stereo that are timed now on this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from vdgs.captures.capture import Capture
from vdgs.captures.image_cache import ImageCache
from vdgs.config.method import AnchorConfig, TrainConfig
from vdgs.errors import VdgsError
from vdgs.model.anchors import Anchors
from vdgs.model.initialization.stereo import StereoInputs, compute_dense_points
from vdgs.pipeline.dense_points import fusion_cell
from vdgs.pipeline.train_coarse import initial_coarse_state
from vdgs.system.memory.memory_estimate import MAX_GROWTH, max_growth_factor
from vdgs.system.processor_time import NO_COST, Cost, Moment
from vdgs.system.stop_signals import check_stop_requested
from vdgs.training import TrainingProblem, train

#: Steps at each size that are timed at least, the first of them not; then as many as fit into so many seconds.
MIN_TIMED_STEPS, MAX_TIMED_SECONDS = 4, 1.5
#: What anchors gain where growth decides often, as a share of their number, in photographs of `USUAL_TEXTURE`, with the
#: square of the texture; how many times as many they become in blocks whose growth is compensated below a fixed T_low;
#: and after how many decisions half of that is reached. Measured (`laptop`, texture): 1.4 times at 13, 1.7 and 1.9 at
#: 17 and 16, 4.6 at 34; 1.8 and 2.3 times at 17 with 100 000 iterations; compensated blocks 6 and 12 times.
PLAIN_GAIN, USUAL_TEXTURE, COMPENSATED_GROWTH, HALF_GROWTH_DECISIONS = 1.3, 17.0, 9.0, 8
#: Photographs whose texture is measured, about.
TEXTURE_VIEWS = 6
#: Textures beyond these tell no more.
TEXTURE_RANGE = (8.0, 36.0)
#: Share of a photograph's stereo that confirming its depths adds to finding them.
CONFIRMING = 0.15
#: What measuring a view takes, in training steps of its size: of the coarse model, and of the merged one with its
#: seams; and drawing as many pixels of a map. In processor seconds, starting the process of a block, and all else:
#: reading, cutting, merging, writing the report.
COARSE_VIEW_STEPS, MERGED_VIEW_STEPS, MAP_STEPS, START_SECONDS, OTHER_SECONDS = 8.0, 14.0, 4.0, 5.0, 10.0


@dataclass(frozen=True, kw_only=True)
class StepTimes:
    """What a training step takes."""

    by_downscale: Mapping[int, Cost]
    anchor_share: float
    """Of the time of a step at the largest size, what goes with the number of anchors."""
    slowdown: float
    texture: float
    """Of the photographs (`measure_texture`)."""

    @property
    def at_full_size(self) -> Cost:
        return self.by_downscale[min(self.by_downscale)]

    def stage(self, config: TrainConfig, start: float = 1.0) -> Cost:
        """All steps of a stage, each at the size that the schedule gives it, with anchors that grow from `start` times
        as many as were timed."""
        ends = [begin for begin, _ in config.resolution_schedule[1:]] + [1.0]
        total = NO_COST
        for (begin, factor), end in zip(config.resolution_schedule, ends, strict=True):
            total += self.by_downscale[factor] * (config.iterations * max(0.0, end - begin))
        return total * (1 + self.anchor_share * (start * mean_growth(config, self.texture) - 1))


def expected_growth(config: TrainConfig, texture: float) -> float:
    """How many times their number anchors become in a stage, by estimate."""
    densify = config.densify
    decisions = max(0.0, (densify.stop_fraction * config.iterations - densify.start) / densify.every)
    if not densify.num_levels:
        return 1.0
    gain = PLAIN_GAIN * (float(np.clip(texture, *TEXTURE_RANGE)) / USUAL_TEXTURE) ** 2
    if max_growth_factor(config.compensation) != MAX_GROWTH:
        gain = COMPENSATED_GROWTH - 1
    return 1 + gain * decisions / (decisions + HALF_GROWTH_DECISIONS)


def measure_texture(images: ImageCache) -> float:
    """Mean absolute Laplacian of photographs at the size that is trained on, in grey levels."""
    found = []
    for index in range(0, len(images.views), max(1, len(images.views) // TEXTURE_VIEWS)):
        gray = cv2.cvtColor(images.get(index).image.numpy(), cv2.COLOR_RGB2GRAY).astype(np.float32)
        found.append(float(np.abs(cv2.Laplacian(gray, cv2.CV_32F)).mean()))
    return float(np.mean(found))


def mean_growth(config: TrainConfig, texture: float) -> float:
    """The mean over the steps of a stage: anchors grow from the first decision to the last."""
    first = min(1.0, config.densify.start / max(1, config.iterations))
    middle = (first + max(first, config.densify.stop_fraction)) / 2
    return 1 + (expected_growth(config, texture) - 1) * (1 - middle)


def time_steps(
    stage: TrainingProblem, anchors: Anchors, images: ImageCache, factors: list[int], fit_exposures: bool
) -> StepTimes:
    """Train a few steps at each size, and with half of the anchors at the largest."""
    timed, slowdowns = {}, []
    for factor in factors:
        timed[factor], slowdown = _step_cost(stage, anchors, factor, fit_exposures)
        slowdowns.append(slowdown)
    largest = min(factors)
    half = anchors.select(torch.arange(len(anchors)) % 2 == 0)
    fewer, _ = _step_cost(stage, half, largest, fit_exposures) if len(half) else (timed[largest], 1.0)
    share = 2 * (1 - fewer.processor_seconds / max(timed[largest].processor_seconds, 1e-9))
    return StepTimes(
        by_downscale=timed,
        anchor_share=float(np.clip(share, 0.2, 1.0)),
        slowdown=float(np.median(slowdowns)),
        texture=measure_texture(images),
    )


def _step_cost(stage: TrainingProblem, anchors: Anchors, factor: int, fit_exposures: bool) -> tuple[Cost, float]:
    """Mean of the steps that are tried, without the first, which opens files; and how busy the machine was."""
    at_size = replace(stage, config=replace(stage.config, resolution_schedule=((0.0, factor),)))
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


def time_stereo(capture: Capture, images: ImageCache, config: AnchorConfig) -> float:
    """Processor seconds of the stereo of one photograph; 0 where no photograph can be matched."""
    cameras = [view.camera for view in capture.train_views]

    def read(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        return images.get(index).image.numpy(), None

    def stop(_done: int, _total: int) -> None:
        check_stop_requested()
        raise _Enough

    inputs = StereoInputs(cameras, capture.points, capture.points, read)
    before = Moment.now()
    try:
        with tempfile.TemporaryDirectory(prefix="vdgs-") as folder:
            compute_dense_points(inputs, fusion_cell(capture, config), Path(folder), stop)
    except (_Enough, VdgsError):
        pass
    return Moment.now().cost_since(before).processor_seconds * (1 + CONFIRMING)
