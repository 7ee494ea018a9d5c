"""How much memory training will take, before it takes it, and which settings make it less.

The figures per anchor and per pixel are measured: `experiments/microbench/step.py`, reports/results.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

from vdgs.config.method import CompensationConfig, MethodConfig, ResolutionSchedule, TrainConfig, max_block_anchors
from vdgs.geometry.camera import Camera
from vdgs.system.units import data_size

TrainingKind = Literal["coarse", "block"]

#: A process of vdgs with everything imported.
PROCESS_BYTES = 350_000_000
#: The picture being trained on: itself, its gradient, its target, what the rasterizer notes (65 measured), and the
#: next four photographs in advance.
TRAIN_BYTES_PER_PIXEL = 80
#: ... more where exposures are fitted, where depths are compared, and instead of that with pseudo views, which are
#: drawn beside a picture with depth (21, 40 and 76 measured).
EXPOSURE_BYTES_PER_PIXEL, DEPTH_BYTES_PER_PIXEL, PSEUDO_VIEW_BYTES_PER_PIXEL = 20, 40, 75
#: ... more where photographs show sky before an environment map: 160 for a pixel of sky (measured), of half of a
#: picture (choice).
SKY_BYTES_PER_PIXEL = 80
#: What a step makes of an anchor in view, for each of its Gaussians (measured with ten: 1.55 kB an anchor).
STEP_BYTES_PER_OFFSET = 155
#: An image that is evaluated: maps of errors and of V in double precision; LPIPS's widest layer (choice: not measured).
METRIC_BYTES_PER_PIXEL, LPIPS_BYTES_PER_PIXEL = 400, 2000
#: Anchors may grow to so many times their number where nothing limits them (choice; real captures: 1.2 to 3).
MAX_GROWTH = 3.0
#: ... where growth is compensated below a fixed T_low, under which nearly all of a real capture is (choice; blocks of
#: seneca had 6 and 12 times as many after a ninth of the steps of preset `default`: reports/findings.md).
MAX_COMPENSATED_GROWTH = 15.0
#: Share of a block's anchors that one photograph may see, for the estimate before a block is opened (choice).
MAX_VISIBLE_FRACTION = 0.5
#: Numbers of an anchor apart from its offsets: place, feature, log-scales.
FLOATS_PER_ANCHOR = 3 + 32 + 6


@dataclass(frozen=True, kw_only=True)
class TrainingWorkload:
    """What training works on, as far as memory is concerned."""

    #: Anchors when it starts, and at most (0: no limit, `growth` times as many).
    anchors: int
    max_anchors: int
    #: Gaussians of an anchor.
    offsets: int
    #: Largest share of the anchors that one photograph sees.
    seen: float
    #: Pixels of the largest photograph.
    pixels: int
    #: What a step takes for each of them: `train_bytes_per_pixel`.
    pixel_bytes: int = TRAIN_BYTES_PER_PIXEL
    #: Decoded photographs that are kept.
    image_cache_bytes: int
    #: Anchors that are drawn but never move.
    surroundings: int = 0
    #: Whether training ends with a mean of models, which is kept beside the grown anchors.
    has_swa: bool = False
    #: Whether growth is compensated, for which gradients of each Gaussian are remembered.
    is_compensated: bool = False
    #: How many times their number anchors may become where nothing limits them: `max_growth_factor`.
    growth: float = MAX_GROWTH

    @property
    def max_grown_anchors(self) -> int:
        """Anchors at the end: `max_anchors` stops growth and removes nothing."""
        free = round(self.growth * self.anchors)
        return max(self.anchors, min(free, self.max_anchors)) if self.max_anchors else free


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes, by what takes them."""

    program: int
    images: int
    image: int
    anchors: int
    grown_anchors: int

    @property
    def start(self) -> int:
        return self.program + self.images + self.image + self.anchors

    @property
    def total(self) -> int:
        """With anchors grown."""
        return self.program + self.images + self.image + self.grown_anchors


@dataclass(frozen=True)
class MemoryAdvice:
    """A setting that saves memory: its option, what it needs, and the bytes that it saves by estimate."""

    setting: str
    saved_bytes: int

    def __str__(self) -> str:
        return f"{self.setting} saves about {data_size(self.saved_bytes)}"


def max_growth_factor(config: CompensationConfig) -> float:
    """How many times their number anchors may become where nothing limits them."""
    return MAX_COMPENSATED_GROWTH if config.enabled and not config.t_low_quantile else MAX_GROWTH


def train_bytes_per_pixel(config: TrainConfig, has_sky: bool = False) -> int:
    """What a step takes for each pixel of its photograph; `has_sky`: an environment map is drawn behind."""
    loss, more = config.loss, SKY_BYTES_PER_PIXEL if has_sky else 0
    if loss.pseudo_views:
        more += PSEUDO_VIEW_BYTES_PER_PIXEL
    elif loss.depth_agreement:
        more += DEPTH_BYTES_PER_PIXEL
    return TRAIN_BYTES_PER_PIXEL + more + (EXPOSURE_BYTES_PER_PIXEL if config.exposure_compensation else 0)


def max_image_pixels(cameras: Iterable[Camera], resolutions: ResolutionSchedule) -> int:
    """Pixels of the largest photograph, at the largest size that a resolution schedule gives it."""
    factor = min(factor for _, factor in resolutions)
    return max((camera.width // factor) * (camera.height // factor) for camera in cameras)


def decoded_image_bytes(cameras: Iterable[Camera]) -> int:
    """What all photographs take decoded, in every size that a schedule asks for, each a quarter of the one before."""
    return 3 * sum(camera.width * camera.height for camera in cameras) * 4 // 3


def block_workload(
    method: MethodConfig, anchors: int, total_anchors: int, pixels: int, has_sky: bool = False
) -> TrainingWorkload:
    """The workload of a block with `anchors` of all coarse anchors and photographs of up to `pixels`, before it is
    opened and without cached photographs; `has_sky` as in `train_bytes_per_pixel`. A crop may be a whole photograph. A
    margin that moves is trained, too: about the share by which the expansion makes a disc larger."""
    block, moved = method.block, anchors
    if block.margin != "frozen":
        moved = min(total_anchors, math.ceil(anchors * (1 + method.partition.expansion) ** 2))
    return TrainingWorkload(
        anchors=moved,
        max_anchors=max_block_anchors(block, anchors, total_anchors),
        offsets=method.training.model.num_offsets,
        seen=MAX_VISIBLE_FRACTION,
        pixels=pixels,
        pixel_bytes=train_bytes_per_pixel(method.training, has_sky),
        image_cache_bytes=0,
        surroundings=total_anchors - moved,
        has_swa=block.swa_fraction > 0,
        is_compensated=block.compensation.enabled,
        growth=max_growth_factor(block.compensation),
    )


def bytes_per_anchor(offsets: int, seen: float, is_compensated: bool = False) -> float:
    """Parameters, two moments, a count of updates, a bound on size and statistics of an anchor, what compensated growth
    remembers, and its share of what a step allocates for anchors in view."""
    remembered = 3 * offsets if is_compensated else 0
    state = 3 * model_bytes_per_anchor(offsets) + 4 * (2 + 2 * offsets + 2 + remembered)
    return state + seen * STEP_BYTES_PER_OFFSET * offsets


def model_bytes_per_anchor(offsets: int) -> int:
    """Parameters of an anchor alone."""
    return 4 * (FLOATS_PER_ANCHOR + 3 * offsets)


def _per_grown_anchor(need: TrainingWorkload) -> float:
    # A mean of models holds no positions, which never move.
    mean = model_bytes_per_anchor(need.offsets) - 4 * 3 if need.has_swa else 0
    return bytes_per_anchor(need.offsets, need.seen, need.is_compensated) + mean


def estimate_memory(need: TrainingWorkload) -> MemoryEstimate:
    """What training takes, at its start and once its anchors have grown."""
    in_view = need.seen * STEP_BYTES_PER_OFFSET * need.offsets
    frozen = need.surroundings * (model_bytes_per_anchor(need.offsets) + in_view)
    start = bytes_per_anchor(need.offsets, need.seen, need.is_compensated) * need.anchors
    return MemoryEstimate(
        PROCESS_BYTES, need.image_cache_bytes, need.pixel_bytes * need.pixels,
        round(start + frozen), round(_per_grown_anchor(need) * need.max_grown_anchors + frozen),
    )  # fmt: skip


def render_bytes(model_bytes: int, cached_bytes: int, pixels: int, lpips: bool = False) -> int:
    """What evaluating images of `pixels` takes at most, for models of `model_bytes` on disk, which rendering doubles,
    and `cached_bytes` of other models."""
    features = LPIPS_BYTES_PER_PIXEL if lpips else 0
    return PROCESS_BYTES + 2 * model_bytes + cached_bytes + (METRIC_BYTES_PER_PIXEL + features) * pixels


def memory_advice(need: TrainingWorkload, kind: TrainingKind, to_save: int) -> list[MemoryAdvice]:
    """Settings that help, the one that saves most first. `to_save` bytes decide how low a limit of anchors must be.

    What would save less than a hundredth of the whole is left out.
    """
    total, cached = estimate_memory(need).total, need.image_cache_bytes

    def saved(**changes: Any) -> int:
        return total - estimate_memory(replace(need, **changes)).total

    found = [_fewer_anchors(need, kind, to_save)]
    if kind == "coarse":
        bytes_saved = saved(pixels=need.pixels // 4, image_cache_bytes=cached // 4)
        found.append(MemoryAdvice("photographs of half the size (--downscale or --images images_N)", bytes_saved))
    else:
        half = saved(anchors=need.anchors // 2)
        found.append(MemoryAdvice("vdgs partition with twice the --blocks (smaller blocks)", half))
        found.append(MemoryAdvice("one less of --jobs (blocks at once)", total))
    if need.has_swa:
        option = "--swa-fraction 0" if kind == "coarse" else "--block.swa-fraction 0"
        found.append(MemoryAdvice(f"{option} (the last model instead of a mean)", saved(has_swa=False)))
    least = min(cached, 50_000_000)
    option = f"--image-cache-gb {least / 1e9:.2f} (fewer photographs kept in memory)"
    found.append(MemoryAdvice(option, cached - least))
    return sorted((each for each in found if each.saved_bytes > total / 100), key=lambda each: -each.saved_bytes)


def _fewer_anchors(need: TrainingWorkload, kind: TrainingKind, to_save: int) -> MemoryAdvice:
    """A limit of anchors that saves `to_save` bytes, if one does: growth can be forbidden, but no anchor removed."""
    option = "--densify.max-anchors" if kind == "coarse" else "--block.densify.max-anchors"
    too_many = to_save / _per_grown_anchor(need)
    limit = max(need.anchors, int(need.max_grown_anchors - too_many) // 1000 * 1000, 1)
    saved = estimate_memory(need).total - estimate_memory(replace(need, max_anchors=limit)).total
    return MemoryAdvice(f"{option} {limit} (less growth)", saved)


def describe_memory(estimate: MemoryEstimate, available_bytes: int) -> str:
    """One line: what is needed, what for, and what there is."""
    more = estimate.grown_anchors > estimate.anchors
    grown = f", {data_size(estimate.grown_anchors)} once they have grown" if more else ""
    return (
        f"memory by estimate: {data_size(estimate.start)} at the start, {data_size(estimate.total)} at most "
        f"(photographs {data_size(estimate.images)}, one picture {data_size(estimate.image)}, anchors "
        f"{data_size(estimate.anchors)}{grown}); this process may take {data_size(available_bytes)}"
    )
